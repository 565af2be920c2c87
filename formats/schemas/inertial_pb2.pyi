from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Imu(_message.Message):
    __slots__ = ("timestamp", "device", "time_ns", "acceleration_m_s2", "angular_rate_rad_s", "device_ticks")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    ANGULAR_RATE_RAD_S_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICKS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    device: str
    time_ns: _containers.RepeatedScalarFieldContainer[int]
    acceleration_m_s2: _containers.RepeatedScalarFieldContainer[float]
    angular_rate_rad_s: _containers.RepeatedScalarFieldContainer[float]
    device_ticks: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., device: _Optional[str] = ..., time_ns: _Optional[_Iterable[int]] = ..., acceleration_m_s2: _Optional[_Iterable[float]] = ..., angular_rate_rad_s: _Optional[_Iterable[float]] = ..., device_ticks: _Optional[_Iterable[int]] = ...) -> None: ...
