"""gRPC service of the simulated device, with the protocol of NI's gRPC Device Server.

Calls arrive in gRPC's threads; one lock serializes them. Only the calls needed for an input, an
output and digital lines are implemented; all others return UNIMPLEMENTED.
"""

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc
from session_pb2 import Session

from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.driver import error_name
from table_io.clock import Clock
from table_io.sim.ni.device import (
    DEFAULT_FIFO_SAMPLES,
    WHEN_NOT_FULL,
    DriverError,
    ErrorCode,
    SimulatedDaqDevice,
    Task,
)

# DAQmx attribute numbers.
DEVICE_NAMES, PRODUCT_TYPE, SERIAL_NUMBER, IS_SIMULATED = 0x193B, 0x0631, 0x0632, 0x22CA
AI_CHANNELS, AO_CHANNELS, DI_LINES, DO_LINES = 0x231E, 0x231F, 0x2320, 0x2321
AI_RANGES, AO_RANGES, AI_MAX_RATE, AO_MAX_RATE = 0x2990, 0x299B, 0x298C, 0x2997


def list_names(wiring: NiWiring, device: str, attribute: int) -> str | None:
    """Return the value of a text attribute, names separated by commas; None if unknown."""
    inputs = [analog_input.physical for analog_input in wiring.inputs]
    values = {
        AI_CHANNELS: inputs,
        AO_CHANNELS: [wiring.output],
        DI_LINES: [wiring.heartbeat, *wiring.digital_inputs.values()],
        DO_LINES: [wiring.heartbeat],
    }
    if attribute == DEVICE_NAMES:
        terminals = [*inputs, wiring.output, wiring.heartbeat]
        return ", ".join(dict.fromkeys(terminal.split("/")[0] for terminal in terminals))
    if attribute == PRODUCT_TYPE:
        return "Simulated table"
    if attribute not in values:
        return None
    return ", ".join(terminal for terminal in values[attribute] if terminal.split("/")[0] == device)


def list_numbers(attribute: int, max_rate_hz: float) -> tuple[float, ...]:
    """Return a numeric attribute: ranges (low, high, ...) in V, rates in Hz; empty if unknown."""
    values = {
        SERIAL_NUMBER: (0.0,),
        IS_SIMULATED: (1.0,),
        AI_RANGES: (-10.0, 10.0),
        AO_RANGES: (-10.0, 10.0),
        AI_MAX_RATE: (max_rate_hz,),
        AO_MAX_RATE: (max_rate_hz,),
    }
    return values.get(attribute, ())


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
            text = list_names(self._wiring, device, request.attribute_raw)
            if text is None:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
            return text

        return self._call_device(context, read)

    def _read_numbers(self, request: Any, context: Any) -> tuple[float, ...]:
        def read(now_s: float) -> tuple[float, ...]:
            numbers = list_numbers(request.attribute_raw, max(self.device.rates_hz))
            if not numbers:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
            return numbers

        return self._call_device(context, read)


POLL_S = 0.002  # between two polls for late samples
MAX_READ_WAIT_S = 10.0  # limit of the time-out that a read may ask for
# DAQmx attribute numbers.
POSITION_ATTRIBUTE, ONBOARD_ATTRIBUTE, TRANSFER_CONDITION_ATTRIBUTE = 0x1458, 0x230B, 0x183C
REGENERATION_ALLOWED = 10097  # DAQmx value of the regeneration mode
TASK_RESERVE = 4


class NiDeviceService(DeviceServicer):
    """DAQmx calls on the simulated device."""

    def CreateTask(self, request: Any, context: Any) -> Any:
        def create_task(now_s: float) -> Any:
            task, new = self.device.create_task(
                request.session_name, request.initialization_behavior
            )
            session = Session(name=task.name, id=task.number)
            return pb.CreateTaskResponse(task=session, new_session_initialized=new)

        try:
            return self._call_device(context, create_task)
        except KeyError:
            reason = f"the session {request.session_name!r} exists already, or does not exist"
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, reason)

    def ClearTask(self, request: Any, context: Any) -> Any:
        self._call_device(context, lambda now_s: self.device.clear(self._find_task(request), now_s))
        return pb.ClearTaskResponse()

    def CreateAIVoltageChan(self, request: Any, context: Any) -> Any:
        self._add_channel(request, context, "ai", request.physical_channel)
        return pb.CreateAIVoltageChanResponse()

    def CreateAOVoltageChan(self, request: Any, context: Any) -> Any:
        self._add_channel(request, context, "ao", request.physical_channel)
        return pb.CreateAOVoltageChanResponse()

    def CreateDOChan(self, request: Any, context: Any) -> Any:
        self._add_channel(request, context, "do", request.lines)
        return pb.CreateDOChanResponse()

    def CreateDIChan(self, request: Any, context: Any) -> Any:
        self._add_channel(request, context, "di", request.lines)
        return pb.CreateDIChanResponse()

    def _add_channel(self, request: Any, context: Any, kind: str, physical: str) -> None:
        known_channels = {
            "ai": [analog_input.physical for analog_input in self._wiring.inputs],
            "ao": [self._wiring.output],
            "do": [self._wiring.heartbeat],
            "di": [*self._wiring.digital_inputs.values()],
        }

        def add(now_s: float) -> None:
            if physical not in known_channels[kind]:
                raise DriverError(ErrorCode.NO_SUCH_CHANNEL, f"Physical Channel Name: {physical}")
            self.device.add_channel(self._find_task(request), kind, physical)

        self._call_device(context, add)

    def CfgSampClkTiming(self, request: Any, context: Any) -> Any:
        self._call_device(
            context,
            lambda now_s: self.device.configure_timing(
                self._find_task(request), request.rate, request.source, request.samps_per_chan
            ),
        )
        return pb.CfgSampClkTimingResponse()

    def GetTimingAttributeDouble(self, request: Any, context: Any) -> Any:
        rate = self._call_device(context, lambda now_s: self._find_task(request).rate_hz)
        return pb.GetTimingAttributeDoubleResponse(value=rate)

    def CfgDigEdgeStartTrig(self, request: Any, context: Any) -> Any:
        def configure(now_s: float) -> None:
            self._find_task(request).trigger = request.trigger_source

        self._call_device(context, configure)
        return pb.CfgDigEdgeStartTrigResponse()

    def SetWriteAttributeInt32(self, request: Any, context: Any) -> Any:
        def change(now_s: float) -> None:
            task, value = self._find_task(request), request.value_raw
            match request.attribute_raw:
                case 0x190C:
                    task.relative_to = value
                case 0x190D:
                    task.offset = value
                case 0x1453:
                    task.regenerates = value == REGENERATION_ALLOWED
                case _:
                    raise DriverError(ErrorCode.NOT_SUPPORTED)

        self._call_device(context, change)
        return pb.SetWriteAttributeInt32Response()

    def GetWriteAttributeUInt64(self, request: Any, context: Any) -> Any:
        def value(now_s: float) -> int:
            task = self._find_task(request)
            self.device.advance(now_s)
            return (
                task.written
                if request.attribute_raw == POSITION_ATTRIBUTE
                else task.generated_samples(now_s)
            )

        return pb.GetWriteAttributeUInt64Response(value=self._call_device(context, value))

    def SetBufferAttributeUInt32(self, request: Any, context: Any) -> Any:
        def change(now_s: float) -> None:
            match request.attribute_raw:
                case 0x186D:
                    self._find_task(request).buffer = request.value
                case 0x230B:
                    self._find_task(request).fifo_samples = request.value
                case _:
                    pass  # the buffer of the input has a fixed size

        self._call_device(context, change)
        return pb.SetBufferAttributeUInt32Response()

    def ResetBufferAttribute(self, request: Any, context: Any) -> Any:
        def reset(now_s: float) -> None:
            self._find_task(request).fifo_samples = DEFAULT_FIFO_SAMPLES

        self._call_device(context, reset)
        return pb.ResetBufferAttributeResponse()

    def ResetChanAttribute(self, request: Any, context: Any) -> Any:
        def reset(now_s: float) -> None:
            self._find_task(request).transfer_condition = WHEN_NOT_FULL

        self._call_device(context, reset)
        return pb.ResetChanAttributeResponse()

    def GetBufferAttributeUInt32(self, request: Any, context: Any) -> Any:
        def value(now_s: float) -> int:
            task = self._find_task(request)
            return (
                task.onboard_samples if request.attribute_raw == ONBOARD_ATTRIBUTE else task.buffer
            )

        return pb.GetBufferAttributeUInt32Response(value=self._call_device(context, value))

    def SetChanAttributeInt32(self, request: Any, context: Any) -> Any:
        def change(now_s: float) -> None:
            if request.attribute_raw != TRANSFER_CONDITION_ATTRIBUTE:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
            self._find_task(request).transfer_condition = request.value_raw

        self._call_device(context, change)
        return pb.SetChanAttributeInt32Response()

    def StartTask(self, request: Any, context: Any) -> Any:
        self._call_device(context, lambda now_s: self.device.start(self._find_task(request), now_s))
        return pb.StartTaskResponse()

    def StopTask(self, request: Any, context: Any) -> Any:
        self._call_device(context, lambda now_s: self.device.stop(self._find_task(request), now_s))
        return pb.StopTaskResponse()

    def TaskControl(self, request: Any, context: Any) -> Any:
        def control(now_s: float) -> None:
            task = self._find_task(request)
            if TASK_RESERVE in (request.action_raw, request.action):
                self.device.reserve(task)

        self._call_device(context, control)
        return pb.TaskControlResponse()

    def IsTaskDone(self, request: Any, context: Any) -> Any:
        done = self._call_device(
            context, lambda now_s: self.device.is_done(self._find_task(request), now_s)
        )
        return pb.IsTaskDoneResponse(is_task_done=done)

    def ReadAnalogF64(self, request: Any, context: Any) -> Any:
        """Wait for the samples; after the time-out return those that have arrived."""
        count, deadline_s = (
            request.num_samps_per_chan,
            self._clock.now() + min(request.timeout, MAX_READ_WAIT_S),
        )
        while True:
            due_s, ready = self._call_device(
                context, lambda now_s: self._read_progress(request, count, now_s)
            )
            now_s = self._clock.now()
            if ready or now_s >= deadline_s or not context.is_active():
                break
            self._clock.wait_until(min(max(due_s, now_s + POLL_S), deadline_s))

        volts = self._call_device(
            context, lambda now_s: self.device.read(self._find_task(request), count)
        )
        return pb.ReadAnalogF64Response(
            status=0 if ready else ErrorCode.NOT_YET_AVAILABLE,
            read_array=np.pad(volts, ((0, 0), (0, count - volts.shape[1]))).ravel(),
            samps_per_chan_read=volts.shape[1],
        )

    def _read_progress(self, request: Any, count: int, now_s: float) -> tuple[float, bool]:
        """Return (time in s of the last of `count` samples, True if all have arrived)."""
        task = self._find_task(request)
        ready = self.device.samples_ready(task, count, now_s)
        last = task.total - task.unread + count - 1
        return task.since_s + last / max(task.rate_hz, 1.0), ready

    def WriteAnalogF64(self, request: Any, context: Any) -> Any:
        volts = np.array(request.write_array)
        self._call_device(
            context, lambda now_s: self.device.write(self._find_task(request), volts, now_s)
        )
        return pb.WriteAnalogF64Response(samps_per_chan_written=volts.size)

    def WriteDigitalLines(self, request: Any, context: Any) -> Any:
        self._call_device(
            context, lambda now_s: self.device.write_line(self._find_task(request), now_s)
        )
        self._heartbeat_level = bool(request.write_array[0])
        return pb.WriteDigitalLinesResponse(samps_per_chan_written=1)

    def ReadDigitalLines(self, request: Any, context: Any) -> Any:
        """Return 1 for every line, and the heartbeat level for the line wired back."""
        lines = self._call_device(context, lambda now_s: self._find_task(request).channels)
        levels = bytes(
            self._heartbeat_level if line == self._wiring.heartbeat_back else 1 for line in lines
        )
        return pb.ReadDigitalLinesResponse(
            read_array=levels, samps_per_chan_read=1, num_bytes_per_samp=1
        )
