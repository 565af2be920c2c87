from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class MagnetometerArray(_message.Message):
    __slots__ = ("timestamp", "device", "frame_id", "sensors", "time_ns", "device_ticks", "sequence", "b_tesla", "temperature_celsius")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICKS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    B_TESLA_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_CELSIUS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    device: str
    frame_id: str
    sensors: int
    time_ns: _containers.RepeatedScalarFieldContainer[int]
    device_ticks: _containers.RepeatedScalarFieldContainer[int]
    sequence: _containers.RepeatedScalarFieldContainer[int]
    b_tesla: _containers.RepeatedScalarFieldContainer[float]
    temperature_celsius: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., device: _Optional[str] = ..., frame_id: _Optional[str] = ..., sensors: _Optional[int] = ..., time_ns: _Optional[_Iterable[int]] = ..., device_ticks: _Optional[_Iterable[int]] = ..., sequence: _Optional[_Iterable[int]] = ..., b_tesla: _Optional[_Iterable[float]] = ..., temperature_celsius: _Optional[_Iterable[float]] = ...) -> None: ...

class HallArray(_message.Message):
    __slots__ = ("timestamp", "device", "frame_id", "sensors", "time_ns", "device_ticks", "sequence", "b_tesla")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    SENSORS_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICKS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    B_TESLA_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    device: str
    frame_id: str
    sensors: int
    time_ns: _containers.RepeatedScalarFieldContainer[int]
    device_ticks: _containers.RepeatedScalarFieldContainer[int]
    sequence: _containers.RepeatedScalarFieldContainer[int]
    b_tesla: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., device: _Optional[str] = ..., frame_id: _Optional[str] = ..., sensors: _Optional[int] = ..., time_ns: _Optional[_Iterable[int]] = ..., device_ticks: _Optional[_Iterable[int]] = ..., sequence: _Optional[_Iterable[int]] = ..., b_tesla: _Optional[_Iterable[float]] = ...) -> None: ...
