"""The device behind the protocol of NI's gRPC Device Server: what each call asks of it.

Calls come in threads of gRPC's; one lock lets them to the device one by one. Only what a client of
an input, an output and a line needs is answered; the rest is UNIMPLEMENTED.
"""

from typing import Any

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2 as pb
from session_pb2 import Session

from table_io.backends.ni.calls import Calls
from table_io.backends.ni.task import FULL, Code, DriverError
from table_io.backends.ni.task import ONBOARD as MEMORY

LOOK_S = 0.002  # between two looks for samples that are late
LONGEST_S = 10.0  # that a read may wait
# Attributes, as DAQmx numbers them.
POSITION, ONBOARD, CONDITION = 0x1458, 0x230B, 0x183C
ALLOWED = 10097  # regeneration
RESERVE = 4


class Service(Calls):
    """NI's calls on a device of ours."""

    def CreateTask(self, request: Any, context: Any) -> Any:
        def create(now: float) -> Any:
            task, new = self.device.create(request.session_name, request.initialization_behavior)
            session = Session(name=task.name, id=task.number)
            return pb.CreateTaskResponse(task=session, new_session_initialized=new)

        try:
            return self._do(context, create)
        except KeyError:
            what = f"the session {request.session_name!r} is there already, or is not"
            context.abort(grpc.StatusCode.FAILED_PRECONDITION, what)

    def ClearTask(self, request: Any, context: Any) -> Any:
        self._do(context, lambda now: self.device.clear(self._task(request), now))
        return pb.ClearTaskResponse()

    def CreateAIVoltageChan(self, request: Any, context: Any) -> Any:
        self._channel(request, context, "ai", request.physical_channel)
        return pb.CreateAIVoltageChanResponse()

    def CreateAOVoltageChan(self, request: Any, context: Any) -> Any:
        self._channel(request, context, "ao", request.physical_channel)
        return pb.CreateAOVoltageChanResponse()

    def CreateDOChan(self, request: Any, context: Any) -> Any:
        self._channel(request, context, "do", request.lines)
        return pb.CreateDOChanResponse()

    def CreateDIChan(self, request: Any, context: Any) -> Any:
        self._channel(request, context, "di", request.lines)
        return pb.CreateDIChanResponse()

    def _channel(self, request: Any, context: Any, kind: str, physical: str) -> None:
        here = {
            "ai": [one.physical for one in self._wiring.inputs],
            "ao": [self._wiring.output],
            "do": [self._wiring.heartbeat],
            "di": [*self._wiring.watched.values()],
        }

        def add(now: float) -> None:
            if physical not in here[kind]:
                raise DriverError(Code.NO_SUCH_CHANNEL, f"Physical Channel Name: {physical}")
            self.device.channel(self._task(request), kind, physical)

        self._do(context, add)

    def CfgSampClkTiming(self, request: Any, context: Any) -> Any:
        self._do(
            context,
            lambda now: self.device.timing(
                self._task(request), request.rate, request.source, request.samps_per_chan
            ),
        )
        return pb.CfgSampClkTimingResponse()

    def GetTimingAttributeDouble(self, request: Any, context: Any) -> Any:
        rate = self._do(context, lambda now: self._task(request).rate_hz)
        return pb.GetTimingAttributeDoubleResponse(value=rate)

    def CfgDigEdgeStartTrig(self, request: Any, context: Any) -> Any:
        def configure(now: float) -> None:
            self._task(request).trigger = request.trigger_source

        self._do(context, configure)
        return pb.CfgDigEdgeStartTrigResponse()

    def SetWriteAttributeInt32(self, request: Any, context: Any) -> Any:
        def change(now: float) -> None:
            task, value = self._task(request), request.value_raw
            match request.attribute_raw:
                case 0x190C:
                    task.relative_to = value
                case 0x190D:
                    task.offset = value
                case 0x1453:
                    task.regenerates = value == ALLOWED
                case _:
                    raise DriverError(Code.NOT_SUPPORTED)

        self._do(context, change)
        return pb.SetWriteAttributeInt32Response()

    def GetWriteAttributeUInt64(self, request: Any, context: Any) -> Any:
        def value(now: float) -> int:
            task = self._task(request)
            self.device.advance(now)
            return task.written if request.attribute_raw == POSITION else task.generated(now)

        return pb.GetWriteAttributeUInt64Response(value=self._do(context, value))

    def SetBufferAttributeUInt32(self, request: Any, context: Any) -> Any:
        def change(now: float) -> None:
            match request.attribute_raw:
                case 0x186D:
                    self._task(request).buffer = request.value
                case 0x230B:
                    self._task(request).onboard = request.value
                case _:
                    pass  # the buffer of the input has the size that it needs

        self._do(context, change)
        return pb.SetBufferAttributeUInt32Response()

    def ResetBufferAttribute(self, request: Any, context: Any) -> Any:
        def reset(now: float) -> None:
            self._task(request).onboard = MEMORY

        self._do(context, reset)
        return pb.ResetBufferAttributeResponse()

    def ResetChanAttribute(self, request: Any, context: Any) -> Any:
        def reset(now: float) -> None:
            self._task(request).condition = FULL

        self._do(context, reset)
        return pb.ResetChanAttributeResponse()

    def GetBufferAttributeUInt32(self, request: Any, context: Any) -> Any:
        def value(now: float) -> int:
            task = self._task(request)
            return task.held if request.attribute_raw == ONBOARD else task.buffer

        return pb.GetBufferAttributeUInt32Response(value=self._do(context, value))

    def SetChanAttributeInt32(self, request: Any, context: Any) -> Any:
        def change(now: float) -> None:
            if request.attribute_raw != CONDITION:
                raise DriverError(Code.NOT_SUPPORTED)
            self._task(request).condition = request.value_raw

        self._do(context, change)
        return pb.SetChanAttributeInt32Response()

    def StartTask(self, request: Any, context: Any) -> Any:
        self._do(context, lambda now: self.device.start(self._task(request), now))
        return pb.StartTaskResponse()

    def StopTask(self, request: Any, context: Any) -> Any:
        self._do(context, lambda now: self.device.stop(self._task(request), now))
        return pb.StopTaskResponse()

    def TaskControl(self, request: Any, context: Any) -> Any:
        def control(now: float) -> None:
            task = self._task(request)
            if RESERVE in (request.action_raw, request.action):
                self.device.reserve(task)

        self._do(context, control)
        return pb.TaskControlResponse()

    def IsTaskDone(self, request: Any, context: Any) -> Any:
        done = self._do(context, lambda now: self.device.done(self._task(request), now))
        return pb.IsTaskDoneResponse(is_task_done=done)

    def ReadAnalogF64(self, request: Any, context: Any) -> Any:
        """Waits for the samples, in the time of the device; a time-out hands out what has come."""
        count, until = (
            request.num_samps_per_chan,
            self._clock.now() + min(request.timeout, LONGEST_S),
        )
        while True:
            due_s, ready = self._do(context, lambda now: self._awaited(request, count, now))
            now = self._clock.now()
            if ready or now >= until or not context.is_active():
                break
            self._clock.wait_until(min(max(due_s, now + LOOK_S), until))

        volts = self._do(context, lambda now: self.device.read(self._task(request), count))
        return pb.ReadAnalogF64Response(
            status=0 if ready else Code.NOT_YET_AVAILABLE,
            read_array=np.pad(volts, ((0, 0), (0, count - volts.shape[1]))).ravel(),
            samps_per_chan_read=volts.shape[1],
        )

    def _awaited(self, request: Any, count: int, now: float) -> tuple[float, bool]:
        """(when the last of these samples is taken, True where they have come)."""
        task = self._task(request)
        ready = self.device.ready(task, count, now)
        last = task.total - task.unread + count - 1
        return task.since_s + last / max(task.rate_hz, 1.0), ready

    def WriteAnalogF64(self, request: Any, context: Any) -> Any:
        volts = np.array(request.write_array)
        self._do(context, lambda now: self.device.write(self._task(request), volts, now))
        return pb.WriteAnalogF64Response(samps_per_chan_written=volts.size)

    def WriteDigitalLines(self, request: Any, context: Any) -> Any:
        self._do(context, lambda now: self.device.line(self._task(request), now))
        self._beat = bool(request.write_array[0])
        return pb.WriteDigitalLinesResponse(samps_per_chan_written=1)

    def ReadDigitalLines(self, request: Any, context: Any) -> Any:
        """All is well, and the heartbeat is wired back."""
        lines = self._do(context, lambda now: self._task(request).channels)
        levels = bytes(self._beat if one == self._wiring.heartbeat_back else 1 for one in lines)
        return pb.ReadDigitalLinesResponse(
            read_array=levels, samps_per_chan_read=1, num_bytes_per_samp=1
        )
