"""A Crazyflie that plays a file."""

import json
import os
import threading
import time

from cflib.crtp.crtpstack import CRTPPacket, CRTPPort


class Caller:
    def __init__(self):
        self.callbacks = []

    def add_callback(self, cb):
        self.callbacks.append(cb)

    def call(self, *args):
        for cb in list(self.callbacks):
            cb(*args)


class Toc:
    def __init__(self, names):
        self.names = names

    def get_element_by_complete_name(self, complete_name):
        return complete_name if complete_name in self.names else None


class Localization:
    """Decodes the first byte of any packet of its port as a type, as cflib does."""

    def __init__(self, cf):
        self.cf = cf
        cf.add_port_callback(CRTPPort.LOCALIZATION, self._incoming)

    def _incoming(self, packet):
        self.cf.write("misread" if packet.channel == 3 else "localization")


class Param:
    def __init__(self, cf):
        self.cf = cf
        names = os.environ.get(
            "CRAZYFLIE_PARAMETERS", "lighthouse.enLhRawStream deck.bcLighthouse4"
        )
        self.toc = Toc(names.split())
        self.callbacks = {}

    def add_update_callback(self, group=None, name=None, cb=None):
        self.callbacks.setdefault(f"{group}.{name}", []).append(cb)

    def get_value(self, complete_name, timeout=60):
        return {"deck.bcLighthouse4": "1"}[complete_name]

    def set_value(self, complete_name, value):
        if self.toc.get_element_by_complete_name(complete_name) is None:
            raise KeyError(f"{complete_name} not in param TOC")
        self.cf.write(f"{complete_name}={value}")
        if value:
            threading.Thread(target=self.cf.play, daemon=True).start()
        else:
            self.cf.is_sending = False
        # The Crazyflie confirms later, in another thread.
        confirm = [complete_name, str(value)]
        for cb in self.callbacks.get(complete_name, ()):
            threading.Timer(0.05, cb, confirm).start()


class Log:
    MAX_LEN = 26

    def __init__(self, cf):
        self.cf = cf
        self.blocks = []

    def add_config(self, logconf):
        if 4 * len(logconf.variables) > self.MAX_LEN or logconf.period_in_ms % 10:
            raise AttributeError("The log configuration is too large or has an invalid parameter")
        logconf.cf = self.cf
        self.blocks.append(logconf)


class Crazyflie:
    def __init__(self, link=None, ro_cache=None, rw_cache=None):
        self.callbacks = []
        self.connection_lost = Caller()
        self.link_uri = ""
        self.is_open = self.is_sending = False
        self.loc = Localization(self)
        self.log = Log(self)
        self.param = Param(self)

    def write(self, line):
        with open(os.environ["CRAZYFLIE_DIARY"], "a") as diary:
            diary.write(line + "\n")

    def is_connected(self):
        return self.is_open

    def add_port_callback(self, port, cb):
        self.add_header_callback(cb, port, 0, 0xFF, 0x0)

    def remove_port_callback(self, port, cb):
        self.remove_header_callback(cb, port, 0, 0xFF, 0x0)

    def add_header_callback(self, cb, port, channel, port_mask=0xFF, channel_mask=0xFF):
        self.callbacks.append((port, port_mask, channel, channel_mask, cb))

    def remove_header_callback(self, cb, port, channel, port_mask=0xFF, channel_mask=0xFF):
        entry = (port, port_mask, channel, channel_mask, cb)
        self.callbacks = [each for each in self.callbacks if each != entry]

    def take(self, packet):
        for port, port_mask, channel, channel_mask, cb in list(self.callbacks):
            if port == packet.port & port_mask and channel == packet.channel & channel_mask:
                cb(packet)

    def play(self):
        self.is_sending = True
        start = time.monotonic()
        with open(os.environ["CRAZYFLIE_FLIGHT"]) as lines:
            for line in lines:
                time_s, kind, *rest = json.loads(line)
                time.sleep(max(0.0, start + time_s - time.monotonic()))
                if not self.is_sending:
                    return
                if kind == "raw":
                    self.take(CRTPPacket(CRTPPort.LOCALIZATION, 3, bytes.fromhex(rest[0])))
                elif kind == "lost":
                    self.is_open = False
                    self.connection_lost.call(self.link_uri, "Too many packets lost\n\ndetails")
                else:
                    self.report(*rest)

    def report(self, first, stamp, values):
        for block in self.log.blocks:
            if block.is_started and block.variables[0] == first:
                named = dict(zip(block.variables, values, strict=True))
                block.data_received_cb.call(stamp, named, block)
