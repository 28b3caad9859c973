"""What every call on the device shares, and what the driver and its devices say of themselves."""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import grpc
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends.ni import inventory
from table_io.backends.ni.codes import name_of
from table_io.backends.ni.device import Device
from table_io.backends.ni.task import Code, DriverError, Task
from table_io.clock import Clock
from table_io.wiring.ni import NiWiring

VERSION = {0x1272: 24, 0x1923: 5, 0x2F22: 0}  # of the driver: major, minor, update
TASK_NAME, CHANNELS = 0x1276, 0x1273  # attributes, as DAQmx numbers them

T = TypeVar("T")


class Calls(rpc.NiDAQmxServicer):  # type: ignore[misc]
    """One lock before a device, its errors, and what it is asked of itself."""

    def __init__(self, device: Device, wiring: NiWiring, clock: Clock) -> None:
        self.device = device
        self.lock = threading.Lock()
        self._wiring = wiring
        self._clock = clock
        self._beat = False  # level of the heartbeat line

    def turn(self) -> None:
        """Let the device live on while nobody calls."""
        with self.lock:
            self.device.advance(self._clock.now())

    def _do(self, context: Any, act: Callable[[float], T]) -> T:
        """What `act` does at the present time; its error goes to the client."""
        try:
            with self.lock:
                return act(self._clock.now())
        except DriverError as error:
            context.set_trailing_metadata((("ni-error", str(error.code)),))
            words = f"{name_of(error.code)}\n\n{error.about}\n\nStatus Code: {error.code}"
            context.abort(grpc.StatusCode.UNKNOWN, words)
            raise

    def _task(self, request: Any) -> Task:
        return self.device.task(request.task.id)

    def GetErrorString(self, request: Any, context: Any) -> Any:
        return pb.GetErrorStringResponse(error_string=name_of(request.error_code))

    def GetTaskAttributeString(self, request: Any, context: Any) -> Any:
        task = self._do(context, lambda now: self._task(request))
        text = {TASK_NAME: task.name, CHANNELS: ", ".join(task.channels)}
        return pb.GetTaskAttributeStringResponse(value=text.get(request.attribute_raw, ""))

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> Any:
        version = VERSION.get(request.attribute_raw, 0)
        return pb.GetSystemInfoAttributeUInt32Response(value=version)

    def GetSystemInfoAttributeString(self, request: Any, context: Any) -> Any:
        return pb.GetSystemInfoAttributeStringResponse(value=self._names("", request, context))

    def GetDeviceAttributeString(self, request: Any, context: Any) -> Any:
        value = self._names(request.device_name, request, context)
        return pb.GetDeviceAttributeStringResponse(value=value)

    def GetDeviceAttributeUInt32(self, request: Any, context: Any) -> Any:
        value = int(self._numbers(request, context)[0])
        return pb.GetDeviceAttributeUInt32Response(value=value)

    def GetDeviceAttributeBool(self, request: Any, context: Any) -> Any:
        value = bool(self._numbers(request, context)[0])
        return pb.GetDeviceAttributeBoolResponse(value=value)

    def GetDeviceAttributeDouble(self, request: Any, context: Any) -> Any:
        return pb.GetDeviceAttributeDoubleResponse(value=self._numbers(request, context)[0])

    def GetDeviceAttributeDoubleArray(self, request: Any, context: Any) -> Any:
        return pb.GetDeviceAttributeDoubleArrayResponse(value=self._numbers(request, context))

    def _names(self, device: str, request: Any, context: Any) -> str:
        def told(now: float) -> str:
            text = inventory.names(self._wiring, device, request.attribute_raw)
            if text is None:
                raise DriverError(Code.NOT_SUPPORTED)
            return text

        return self._do(context, told)

    def _numbers(self, request: Any, context: Any) -> tuple[float, ...]:
        def told(now: float) -> tuple[float, ...]:
            found = inventory.numbers(request.attribute_raw, max(self.device.rates_hz))
            if not found:
                raise DriverError(Code.NOT_SUPPORTED)
            return found

        return self._do(context, told)
