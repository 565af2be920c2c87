"""Logs of a Crazyflie's micro SD card deck.

``log_file`` reads the binary file into columns, ``variables`` converts log variables to samples of
the IMU and an on-board trajectory (also those of CSV files), ``sweeps`` converts the events of the
Lighthouse deck to sweeps, and ``recording`` imports all of them as a session.
"""
