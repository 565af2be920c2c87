from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LighthouseCapture(_message.Message):
    __slots__ = ("timestamp", "device", "time_ns", "sensor", "bits", "polynomial", "bit_offset", "device_ticks")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    BITS_FIELD_NUMBER: _ClassVar[int]
    POLYNOMIAL_FIELD_NUMBER: _ClassVar[int]
    BIT_OFFSET_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICKS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    device: str
    time_ns: _containers.RepeatedScalarFieldContainer[int]
    sensor: _containers.RepeatedScalarFieldContainer[int]
    bits: _containers.RepeatedScalarFieldContainer[int]
    polynomial: _containers.RepeatedScalarFieldContainer[int]
    bit_offset: _containers.RepeatedScalarFieldContainer[int]
    device_ticks: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., device: _Optional[str] = ..., time_ns: _Optional[_Iterable[int]] = ..., sensor: _Optional[_Iterable[int]] = ..., bits: _Optional[_Iterable[int]] = ..., polynomial: _Optional[_Iterable[int]] = ..., bit_offset: _Optional[_Iterable[int]] = ..., device_ticks: _Optional[_Iterable[int]] = ...) -> None: ...

class LighthouseSweep(_message.Message):
    __slots__ = ("timestamp", "device", "time_ns", "sensor", "channel", "polynomial", "sweep", "count", "device_ticks")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    POLYNOMIAL_FIELD_NUMBER: _ClassVar[int]
    SWEEP_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TICKS_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    device: str
    time_ns: _containers.RepeatedScalarFieldContainer[int]
    sensor: _containers.RepeatedScalarFieldContainer[int]
    channel: _containers.RepeatedScalarFieldContainer[int]
    polynomial: _containers.RepeatedScalarFieldContainer[int]
    sweep: _containers.RepeatedScalarFieldContainer[int]
    count: _containers.RepeatedScalarFieldContainer[float]
    device_ticks: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, timestamp: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., device: _Optional[str] = ..., time_ns: _Optional[_Iterable[int]] = ..., sensor: _Optional[_Iterable[int]] = ..., channel: _Optional[_Iterable[int]] = ..., polynomial: _Optional[_Iterable[int]] = ..., sweep: _Optional[_Iterable[int]] = ..., count: _Optional[_Iterable[float]] = ..., device_ticks: _Optional[_Iterable[int]] = ...) -> None: ...
