"""gRPC service of the simulated device, with the protocol of NI's gRPC Device Server.

Calls arrive in gRPC's threads; one lock serializes them. Only the calls needed for an input, an
output and digital lines are implemented; all others return UNIMPLEMENTED.
"""

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc
from session_pb2 import Session

from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.driver import error_name
from table_io.block import Float2D
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


DRIVER_VERSION = {0x1272: 24, 0x1923: 5, 0x2F22: 0}  # attributes major, minor, update
TASK_NAME_ATTRIBUTE, CHANNELS_ATTRIBUTE = 0x1276, 0x1273
POSITION_ATTRIBUTE, ONBOARD_ATTRIBUTE, TRANSFER_CONDITION_ATTRIBUTE = 0x1458, 0x230B, 0x183C
POLL_S = 0.002  # between two polls for late samples
MAX_READ_WAIT_S = 10.0  # limit of the time-out that a read may ask for
REGENERATION_ALLOWED = 10097  # DAQmx value of the regeneration mode
TASK_RESERVE = 4

T = TypeVar("T")
Rpc = Callable[["NiDeviceService", Any, Any], Any]  # (service, request, context) -> response


def call_device(method: Callable[["NiDeviceService", Any, float], Any]) -> Rpc:
    """Make an RPC of a method (request, now_s) -> response that runs under the device's lock."""

    @wraps(method)
    def call(service: "NiDeviceService", request: Any, context: Any) -> Any:
        return service.run_locked(context, lambda now_s: method(service, request, now_s))

    return call


def call_task(method: Callable[["NiDeviceService", Task, Any, float], Any]) -> Rpc:
    """Make an RPC of a method (task, request, now_s) -> response on the task of the request."""

    @wraps(method)
    def call(service: "NiDeviceService", request: Any, now_s: float) -> Any:
        return method(service, service.device.find_task(request.task.id), request, now_s)

    return call_device(call)


class NiDeviceService(rpc.NiDAQmxServicer):  # type: ignore[misc]
    """DAQmx calls on the simulated device, with one lock and reporting of its errors."""

    def __init__(self, device: SimulatedDaqDevice, wiring: NiWiring, clock: Clock) -> None:
        self.device = device
        self.lock = threading.Lock()
        self._wiring = wiring
        self._clock = clock
        self._heartbeat_level = False  # level of the heartbeat line
        self._channels = {
            "ai": [analog_input.physical for analog_input in wiring.inputs],
            "ao": [wiring.output],
            "do": [wiring.heartbeat],
            "di": [*wiring.digital_inputs.values()],
        }

    def advance(self) -> None:
        """Advance the device between calls."""
        with self.lock:
            self.device.advance(self._clock.now())

    def run_locked(self, context: Any, call: Callable[[float], T]) -> T:
        """Return `call(now_s)` under the lock; report its DriverError to the client."""
        try:
            with self.lock:
                return call(self._clock.now())
        except DriverError as error:
            context.set_trailing_metadata((("ni-error", str(error.code)),))
            message = f"{error_name(error.code)}\n\n{error.details}\n\nStatus Code: {error.code}"
            context.abort(grpc.StatusCode.UNKNOWN, message)
            raise

    def GetErrorString(self, request: Any, context: Any) -> Any:
        return pb.GetErrorStringResponse(error_string=error_name(request.error_code))

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> Any:
        version = DRIVER_VERSION.get(request.attribute_raw, 0)
        return pb.GetSystemInfoAttributeUInt32Response(value=version)

    @call_task
    def GetTaskAttributeString(self, task: Task, request: Any, now_s: float) -> Any:
        text = {TASK_NAME_ATTRIBUTE: task.name, CHANNELS_ATTRIBUTE: ", ".join(task.channels)}
        return pb.GetTaskAttributeStringResponse(value=text.get(request.attribute_raw, ""))

    @call_device
    def GetSystemInfoAttributeString(self, request: Any, now_s: float) -> Any:
        return pb.GetSystemInfoAttributeStringResponse(value=self._list_names("", request))

    @call_device
    def GetDeviceAttributeString(self, request: Any, now_s: float) -> Any:
        value = self._list_names(request.device_name, request)
        return pb.GetDeviceAttributeStringResponse(value=value)

    @call_device
    def GetDeviceAttributeUInt32(self, request: Any, now_s: float) -> Any:
        return pb.GetDeviceAttributeUInt32Response(value=int(self._list_numbers(request)[0]))

    @call_device
    def GetDeviceAttributeBool(self, request: Any, now_s: float) -> Any:
        return pb.GetDeviceAttributeBoolResponse(value=bool(self._list_numbers(request)[0]))

    @call_device
    def GetDeviceAttributeDouble(self, request: Any, now_s: float) -> Any:
        return pb.GetDeviceAttributeDoubleResponse(value=self._list_numbers(request)[0])

    @call_device
    def GetDeviceAttributeDoubleArray(self, request: Any, now_s: float) -> Any:
        return pb.GetDeviceAttributeDoubleArrayResponse(value=self._list_numbers(request))

    def _list_names(self, device: str, request: Any) -> str:
        """Return the value of a text attribute, names separated by commas."""
        inputs, wiring = self._channels["ai"], self._wiring
        if request.attribute_raw == DEVICE_NAMES:
            terminals = [*inputs, wiring.output, wiring.heartbeat]
            return ", ".join(dict.fromkeys(terminal.split("/")[0] for terminal in terminals))
        if request.attribute_raw == PRODUCT_TYPE:
            return "Simulated table"
        terminals_by_attribute = {
            AI_CHANNELS: inputs,
            AO_CHANNELS: [wiring.output],
            DI_LINES: [wiring.heartbeat, *wiring.digital_inputs.values()],
            DO_LINES: [wiring.heartbeat],
        }
        if request.attribute_raw not in terminals_by_attribute:
            raise DriverError(ErrorCode.NOT_SUPPORTED)
        terminals = terminals_by_attribute[request.attribute_raw]
        return ", ".join(terminal for terminal in terminals if terminal.split("/")[0] == device)

    def _list_numbers(self, request: Any) -> tuple[float, ...]:
        """Return a numeric attribute: ranges (low, high, ...) in V, rates in Hz."""
        max_rate_hz = max(self.device.rates_hz)
        numbers = {
            SERIAL_NUMBER: (0.0,),
            IS_SIMULATED: (1.0,),
            AI_RANGES: (-10.0, 10.0),
            AO_RANGES: (-10.0, 10.0),
            AI_MAX_RATE: (max_rate_hz,),
            AO_MAX_RATE: (max_rate_hz,),
        }
        if request.attribute_raw not in numbers:
            raise DriverError(ErrorCode.NOT_SUPPORTED)
        return numbers[request.attribute_raw]

    def CreateTask(self, request: Any, context: Any) -> Any:
        def create_task(now_s: float) -> Any:
            task, new = self.device.create_task(
                request.session_name, request.initialization_behavior
            )
            session = Session(name=task.name, id=task.number)
            return pb.CreateTaskResponse(task=session, new_session_initialized=new)

        try:
            return self.run_locked(context, create_task)
        except KeyError:
            reason = f"the session {request.session_name!r} exists already, or does not exist"
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, reason)

    @call_task
    def ClearTask(self, task: Task, request: Any, now_s: float) -> Any:
        self.device.clear(task, now_s)
        return pb.ClearTaskResponse()

    @call_device
    def CreateAIVoltageChan(self, request: Any, now_s: float) -> Any:
        self._add_channel(request, "ai", request.physical_channel)
        return pb.CreateAIVoltageChanResponse()

    @call_device
    def CreateAOVoltageChan(self, request: Any, now_s: float) -> Any:
        self._add_channel(request, "ao", request.physical_channel)
        return pb.CreateAOVoltageChanResponse()

    @call_device
    def CreateDOChan(self, request: Any, now_s: float) -> Any:
        self._add_channel(request, "do", request.lines)
        return pb.CreateDOChanResponse()

    @call_device
    def CreateDIChan(self, request: Any, now_s: float) -> Any:
        self._add_channel(request, "di", request.lines)
        return pb.CreateDIChanResponse()

    def _add_channel(self, request: Any, kind: str, physical: str) -> None:
        if physical not in self._channels[kind]:
            raise DriverError(ErrorCode.NO_SUCH_CHANNEL, f"Physical Channel Name: {physical}")
        self.device.add_channel(self.device.find_task(request.task.id), kind, physical)

    @call_task
    def CfgSampClkTiming(self, task: Task, request: Any, now_s: float) -> Any:
        samples = request.samps_per_chan
        self.device.configure_timing(task, request.rate, request.source, samples)
        return pb.CfgSampClkTimingResponse()

    @call_task
    def GetTimingAttributeDouble(self, task: Task, request: Any, now_s: float) -> Any:
        return pb.GetTimingAttributeDoubleResponse(value=task.rate_hz)

    @call_task
    def CfgDigEdgeStartTrig(self, task: Task, request: Any, now_s: float) -> Any:
        task.trigger = request.trigger_source
        return pb.CfgDigEdgeStartTrigResponse()

    @call_task
    def SetWriteAttributeInt32(self, task: Task, request: Any, now_s: float) -> Any:
        match request.attribute_raw:
            case 0x190C:
                task.relative_to = request.value_raw
            case 0x190D:
                task.offset = request.value_raw
            case 0x1453:
                task.regenerates = request.value_raw == REGENERATION_ALLOWED
            case _:
                raise DriverError(ErrorCode.NOT_SUPPORTED)
        return pb.SetWriteAttributeInt32Response()

    @call_task
    def GetWriteAttributeUInt64(self, task: Task, request: Any, now_s: float) -> Any:
        self.device.advance(now_s)
        is_position = request.attribute_raw == POSITION_ATTRIBUTE
        value = task.written if is_position else task.generated_samples(now_s)
        return pb.GetWriteAttributeUInt64Response(value=value)

    @call_task
    def SetBufferAttributeUInt32(self, task: Task, request: Any, now_s: float) -> Any:
        match request.attribute_raw:
            case 0x186D:
                task.buffer = request.value
            case 0x230B:
                task.fifo_samples = request.value
            case _:
                pass  # the buffer of the input has a fixed size
        return pb.SetBufferAttributeUInt32Response()

    @call_task
    def ResetBufferAttribute(self, task: Task, request: Any, now_s: float) -> Any:
        task.fifo_samples = DEFAULT_FIFO_SAMPLES
        return pb.ResetBufferAttributeResponse()

    @call_task
    def ResetChanAttribute(self, task: Task, request: Any, now_s: float) -> Any:
        task.transfer_condition = WHEN_NOT_FULL
        return pb.ResetChanAttributeResponse()

    @call_task
    def GetBufferAttributeUInt32(self, task: Task, request: Any, now_s: float) -> Any:
        is_onboard = request.attribute_raw == ONBOARD_ATTRIBUTE
        value = task.onboard_samples if is_onboard else task.buffer
        return pb.GetBufferAttributeUInt32Response(value=value)

    @call_task
    def SetChanAttributeInt32(self, task: Task, request: Any, now_s: float) -> Any:
        if request.attribute_raw != TRANSFER_CONDITION_ATTRIBUTE:
            raise DriverError(ErrorCode.NOT_SUPPORTED)
        task.transfer_condition = request.value_raw
        return pb.SetChanAttributeInt32Response()

    @call_task
    def StartTask(self, task: Task, request: Any, now_s: float) -> Any:
        self.device.start(task, now_s)
        return pb.StartTaskResponse()

    @call_task
    def StopTask(self, task: Task, request: Any, now_s: float) -> Any:
        self.device.stop(task, now_s)
        return pb.StopTaskResponse()

    @call_task
    def TaskControl(self, task: Task, request: Any, now_s: float) -> Any:
        if TASK_RESERVE in (request.action_raw, request.action):
            self.device.reserve(task)
        return pb.TaskControlResponse()

    @call_task
    def IsTaskDone(self, task: Task, request: Any, now_s: float) -> Any:
        return pb.IsTaskDoneResponse(is_task_done=self.device.is_done(task, now_s))

    def ReadAnalogF64(self, request: Any, context: Any) -> Any:
        """Wait for the samples; after the time-out return those that have arrived."""
        count = request.num_samps_per_chan
        deadline_s = self._clock.now() + min(request.timeout, MAX_READ_WAIT_S)

        def read_progress(now_s: float) -> tuple[float, bool]:
            """Return (time in s of the last sample, True if all have arrived)."""
            task = self.device.find_task(request.task.id)
            ready = self.device.samples_ready(task, count, now_s)
            last = task.samples.next_read + count - 1
            return task.since_s + last / max(task.rate_hz, 1.0), ready

        def read(now_s: float) -> Float2D:
            return self.device.read(self.device.find_task(request.task.id), count)

        while True:
            due_s, ready = self.run_locked(context, read_progress)
            now_s = self._clock.now()
            if ready or now_s >= deadline_s or not context.is_active():
                break
            self._clock.wait_until(min(max(due_s, now_s + POLL_S), deadline_s))
        volts = self.run_locked(context, read)
        return pb.ReadAnalogF64Response(
            status=0 if ready else ErrorCode.NOT_YET_AVAILABLE,
            read_array=np.pad(volts, ((0, 0), (0, count - volts.shape[1]))).ravel(),
            samps_per_chan_read=volts.shape[1],
        )

    @call_task
    def WriteAnalogF64(self, task: Task, request: Any, now_s: float) -> Any:
        volts = np.array(request.write_array)
        self.device.write(task, volts, now_s)
        return pb.WriteAnalogF64Response(samps_per_chan_written=volts.size)

    @call_task
    def WriteDigitalLines(self, task: Task, request: Any, now_s: float) -> Any:
        self.device.write_line(task, now_s)
        self._heartbeat_level = bool(request.write_array[0])
        return pb.WriteDigitalLinesResponse(samps_per_chan_written=1)

    @call_task
    def ReadDigitalLines(self, task: Task, request: Any, now_s: float) -> Any:
        """Return 1 for every line, and the heartbeat level for the line wired back."""
        back = self._wiring.heartbeat_back
        levels = bytes(self._heartbeat_level if line == back else 1 for line in task.channels)
        return pb.ReadDigitalLinesResponse(
            read_array=levels, samps_per_chan_read=1, num_bytes_per_samp=1
        )
