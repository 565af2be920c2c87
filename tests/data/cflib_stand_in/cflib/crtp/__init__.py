"""Drivers of links; there is one, for the URI ``radio://stand-in``."""

is_ready = False


def init_drivers(enable_debug_driver=False, enable_serial_driver=False):
    global is_ready
    is_ready = True
