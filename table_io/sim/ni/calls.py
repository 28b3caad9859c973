"""Base of the gRPC service: locking, error reporting, properties of driver and device."""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import grpc
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.errors import error_name
from table_io.clock import Clock
from table_io.sim.ni import inventory
from table_io.sim.ni.device import SimulatedDaqDevice
from table_io.sim.ni.task import DriverError, ErrorCode, Task

DRIVER_VERSION = {0x1272: 24, 0x1923: 5, 0x2F22: 0}  # attributes major, minor, update
TASK_NAME_ATTRIBUTE, CHANNELS_ATTRIBUTE = 0x1276, 0x1273  # DAQmx attribute numbers

T = TypeVar("T")


class DeviceServicer(rpc.NiDAQmxServicer):  # type: ignore[misc]
    """Service with one lock for the device, error reporting and property calls."""

    def __init__(self, device: SimulatedDaqDevice, wiring: NiWiring, clock: Clock) -> None:
        self.device = device
        self.lock = threading.Lock()
        self._wiring = wiring
        self._clock = clock
        self._heartbeat_level = False  # level of the heartbeat line

    def advance(self) -> None:
        """Advance the device between calls."""
        with self.lock:
            self.device.advance(self._clock.now())

    def _call_device(self, context: Any, call: Callable[[float], T]) -> T:
        """Return `call(now_s)` under the lock; report its DriverError to the client."""
        try:
            with self.lock:
                return call(self._clock.now())
        except DriverError as error:
            context.set_trailing_metadata((("ni-error", str(error.code)),))
            message = f"{error_name(error.code)}\n\n{error.details}\n\nStatus Code: {error.code}"
            context.abort(grpc.StatusCode.UNKNOWN, message)
            raise

    def _find_task(self, request: Any) -> Task:
        return self.device.find_task(request.task.id)

    def GetErrorString(self, request: Any, context: Any) -> Any:
        return pb.GetErrorStringResponse(error_string=error_name(request.error_code))

    def GetTaskAttributeString(self, request: Any, context: Any) -> Any:
        task = self._call_device(context, lambda now_s: self._find_task(request))
        text = {TASK_NAME_ATTRIBUTE: task.name, CHANNELS_ATTRIBUTE: ", ".join(task.channels)}
        return pb.GetTaskAttributeStringResponse(value=text.get(request.attribute_raw, ""))

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> Any:
        version = DRIVER_VERSION.get(request.attribute_raw, 0)
        return pb.GetSystemInfoAttributeUInt32Response(value=version)

    def GetSystemInfoAttributeString(self, request: Any, context: Any) -> Any:
        return pb.GetSystemInfoAttributeStringResponse(value=self._read_names("", request, context))

    def GetDeviceAttributeString(self, request: Any, context: Any) -> Any:
        value = self._read_names(request.device_name, request, context)
        return pb.GetDeviceAttributeStringResponse(value=value)

    def GetDeviceAttributeUInt32(self, request: Any, context: Any) -> Any:
        value = int(self._read_numbers(request, context)[0])
        return pb.GetDeviceAttributeUInt32Response(value=value)

    def GetDeviceAttributeBool(self, request: Any, context: Any) -> Any:
        value = bool(self._read_numbers(request, context)[0])
        return pb.GetDeviceAttributeBoolResponse(value=value)

    def GetDeviceAttributeDouble(self, request: Any, context: Any) -> Any:
        return pb.GetDeviceAttributeDoubleResponse(value=self._read_numbers(request, context)[0])

    def GetDeviceAttributeDoubleArray(self, request: Any, context: Any) -> Any:
        return pb.GetDeviceAttributeDoubleArrayResponse(value=self._read_numbers(request, context))

    def _read_names(self, device: str, request: Any, context: Any) -> str:
        def read(now_s: float) -> str:
            text = inventory.list_names(self._wiring, device, request.attribute_raw)
            if text is None:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
            return text

        return self._call_device(context, read)

    def _read_numbers(self, request: Any, context: Any) -> tuple[float, ...]:
        def read(now_s: float) -> tuple[float, ...]:
            numbers = inventory.list_numbers(request.attribute_raw, max(self.device.rates_hz))
            if not numbers:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
            return numbers

        return self._call_device(context, read)
