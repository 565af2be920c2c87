"""Packets of the Crazy RealTime Protocol."""


class CRTPPort:
    PARAM = 0x02
    LOGGING = 0x05
    LOCALIZATION = 0x06


class CRTPPacket:
    def __init__(self, port, channel, data):
        self.port = port
        self.channel = channel
        self.data = bytearray(data)
