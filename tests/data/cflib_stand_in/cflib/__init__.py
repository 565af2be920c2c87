"""Stand-in for cflib: its documented names, with a Crazyflie that plays a file.

The environment variable ``CRAZYFLIE_FLIGHT`` names the file, of lines of JSON::

    [time in s since the stream was switched on, "raw", packet in hexadecimal digits]
    [time in s, "log", name of the first variable, time stamp in ms, [values of the block]]

and ``CRAZYFLIE_DIARY`` a file to which what is asked of the Crazyflie is appended.
"""
