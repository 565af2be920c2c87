"""Blocks of the log."""

from cflib.crazyflie import Caller


class LogConfig:
    def __init__(self, name, period_in_ms):
        self.name = name
        self.period_in_ms = period_in_ms
        self.data_received_cb = Caller()
        self.variables = []
        self.cf = None
        self.is_started = False

    def add_variable(self, name, fetch_as=None):
        assert fetch_as == "float"
        self.variables.append(name)

    def start(self):
        self.cf.write(f"start {self.name}")
        self.is_started = True

    def stop(self):
        self.cf.write(f"stop {self.name}")
        self.is_started = False
