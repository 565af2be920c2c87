"""A Crazyflie whose link is open within a ``with`` block."""

import cflib.crtp
from cflib.crazyflie import Crazyflie


class SyncCrazyflie:
    def __init__(self, link_uri, cf=None):
        self.cf = cf or Crazyflie()
        self._link_uri = link_uri

    def __enter__(self):
        if not cflib.crtp.is_ready or self._link_uri != "radio://stand-in":
            raise Exception("Couldn't load link driver: no Crazyradio\n\nTraceback ...")
        self.cf.link_uri = self._link_uri
        self.cf.is_open = True
        return self

    def __exit__(self, exc_type, exc_val, exc_tb):
        self.cf.write("close")
        self.cf.is_open = False
