from collections.abc import Iterable as _Iterable
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar

from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from google.protobuf.internal import containers as _containers

DESCRIPTOR: _descriptor.FileDescriptor

class Channel(_message.Message):
    __slots__ = ("name", "values")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    name: str
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: str | None = ..., values: _Iterable[float] | None = ...) -> None: ...

class Block(_message.Message):
    __slots__ = ("channels", "cycle", "index", "label", "rate_hz", "run", "step", "stream")
    RUN_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    run: str
    stream: str
    index: int
    rate_hz: float
    channels: _containers.RepeatedCompositeFieldContainer[Channel]
    step: _containers.RepeatedScalarFieldContainer[int]
    label: _containers.RepeatedScalarFieldContainer[int]
    cycle: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, run: str | None = ..., stream: str | None = ..., index: int | None = ..., rate_hz: float | None = ..., channels: _Iterable[Channel | _Mapping] | None = ..., step: _Iterable[int] | None = ..., label: _Iterable[int] | None = ..., cycle: _Iterable[int] | None = ...) -> None: ...

class Step(_message.Message):
    __slots__ = ("acceleration_m_s2", "direction", "frequency_hz", "index")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    index: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float
    def __init__(self, index: int | None = ..., direction: str | None = ..., frequency_hz: float | None = ..., acceleration_m_s2: float | None = ...) -> None: ...

class RunStart(_message.Message):
    __slots__ = ("block_samples", "channels", "epoch_s", "host", "index", "model_toml", "name", "planned_samples", "profile_toml", "rate_hz", "rig_toml", "run", "source", "started_at", "steps", "tare", "versions")
    class TareEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: str | None = ..., value: float | None = ...) -> None: ...
    class VersionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: str | None = ..., value: str | None = ...) -> None: ...
    INDEX_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    PROFILE_TOML_FIELD_NUMBER: _ClassVar[int]
    RIG_TOML_FIELD_NUMBER: _ClassVar[int]
    MODEL_TOML_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    BLOCK_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    PLANNED_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    TARE_FIELD_NUMBER: _ClassVar[int]
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    STARTED_AT_FIELD_NUMBER: _ClassVar[int]
    EPOCH_S_FIELD_NUMBER: _ClassVar[int]
    index: int
    run: str
    name: str
    source: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    rate_hz: float
    block_samples: int
    channels: _containers.RepeatedScalarFieldContainer[str]
    steps: _containers.RepeatedCompositeFieldContainer[Step]
    planned_samples: int
    tare: _containers.ScalarMap[str, float]
    versions: _containers.ScalarMap[str, str]
    host: str
    started_at: str
    epoch_s: float
    def __init__(self, index: int | None = ..., run: str | None = ..., name: str | None = ..., source: str | None = ..., profile_toml: str | None = ..., rig_toml: str | None = ..., model_toml: str | None = ..., rate_hz: float | None = ..., block_samples: int | None = ..., channels: _Iterable[str] | None = ..., steps: _Iterable[Step | _Mapping] | None = ..., planned_samples: int | None = ..., tare: _Mapping[str, float] | None = ..., versions: _Mapping[str, str] | None = ..., host: str | None = ..., started_at: str | None = ..., epoch_s: float | None = ...) -> None: ...

class Params(_message.Message):
    __slots__ = ("index", "reason", "run", "values")
    class ValuesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: str | None = ..., value: float | None = ...) -> None: ...
    INDEX_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    values: _containers.ScalarMap[str, float]
    reason: str
    run: str
    def __init__(self, index: int | None = ..., values: _Mapping[str, float] | None = ..., reason: str | None = ..., run: str | None = ...) -> None: ...

class Comparison(_message.Message):
    __slots__ = ("channels", "count", "free_error_ss", "index", "measured_ss", "run", "window_error_ss")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    MEASURED_SS_FIELD_NUMBER: _ClassVar[int]
    FREE_ERROR_SS_FIELD_NUMBER: _ClassVar[int]
    WINDOW_ERROR_SS_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    count: int
    channels: _containers.RepeatedScalarFieldContainer[str]
    measured_ss: _containers.RepeatedScalarFieldContainer[float]
    free_error_ss: _containers.RepeatedScalarFieldContainer[float]
    window_error_ss: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: int | None = ..., count: int | None = ..., channels: _Iterable[str] | None = ..., measured_ss: _Iterable[float] | None = ..., free_error_ss: _Iterable[float] | None = ..., window_error_ss: _Iterable[float] | None = ..., run: str | None = ...) -> None: ...

class Extremes(_message.Message):
    __slots__ = ("a_max", "a_min", "force_l", "force_r", "onsets_l", "onsets_r", "u_max", "u_min")
    U_MAX_FIELD_NUMBER: _ClassVar[int]
    U_MIN_FIELD_NUMBER: _ClassVar[int]
    A_MAX_FIELD_NUMBER: _ClassVar[int]
    A_MIN_FIELD_NUMBER: _ClassVar[int]
    FORCE_R_FIELD_NUMBER: _ClassVar[int]
    FORCE_L_FIELD_NUMBER: _ClassVar[int]
    ONSETS_R_FIELD_NUMBER: _ClassVar[int]
    ONSETS_L_FIELD_NUMBER: _ClassVar[int]
    u_max: float
    u_min: float
    a_max: float
    a_min: float
    force_r: float
    force_l: float
    onsets_r: _containers.RepeatedScalarFieldContainer[int]
    onsets_l: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, u_max: float | None = ..., u_min: float | None = ..., a_max: float | None = ..., a_min: float | None = ..., force_r: float | None = ..., force_l: float | None = ..., onsets_r: _Iterable[int] | None = ..., onsets_l: _Iterable[int] | None = ...) -> None: ...

class Cycle(_message.Message):
    __slots__ = ("count", "cycle", "index", "label", "measured", "run", "step", "twin")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    TWIN_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    cycle: int
    count: int
    measured: Extremes
    twin: Extremes
    run: str
    label: int
    def __init__(self, index: int | None = ..., step: int | None = ..., cycle: int | None = ..., count: int | None = ..., measured: Extremes | _Mapping | None = ..., twin: Extremes | _Mapping | None = ..., run: str | None = ..., label: int | None = ...) -> None: ...

class Quantities(_message.Message):
    __slots__ = ("drift", "eta_a", "eta_d", "eta_l", "eta_r", "impacts_left", "impacts_right", "r_l", "r_r", "spread")
    ETA_D_FIELD_NUMBER: _ClassVar[int]
    ETA_A_FIELD_NUMBER: _ClassVar[int]
    ETA_R_FIELD_NUMBER: _ClassVar[int]
    ETA_L_FIELD_NUMBER: _ClassVar[int]
    R_R_FIELD_NUMBER: _ClassVar[int]
    R_L_FIELD_NUMBER: _ClassVar[int]
    IMPACTS_RIGHT_FIELD_NUMBER: _ClassVar[int]
    IMPACTS_LEFT_FIELD_NUMBER: _ClassVar[int]
    DRIFT_FIELD_NUMBER: _ClassVar[int]
    SPREAD_FIELD_NUMBER: _ClassVar[int]
    eta_d: float
    eta_a: float
    eta_r: float
    eta_l: float
    r_r: float
    r_l: float
    impacts_right: _containers.RepeatedScalarFieldContainer[int]
    impacts_left: _containers.RepeatedScalarFieldContainer[int]
    drift: float
    spread: float
    def __init__(self, eta_d: float | None = ..., eta_a: float | None = ..., eta_r: float | None = ..., eta_l: float | None = ..., r_r: float | None = ..., r_l: float | None = ..., impacts_right: _Iterable[int] | None = ..., impacts_left: _Iterable[int] | None = ..., drift: float | None = ..., spread: float | None = ...) -> None: ...

class Point(_message.Message):
    __slots__ = ("direction", "frequency_hz", "index", "measured", "run", "step", "table_acc_fundamental_m_s2", "table_acc_peak_m_s2", "thd", "twin")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    MEASURED_FIELD_NUMBER: _ClassVar[int]
    TWIN_FIELD_NUMBER: _ClassVar[int]
    TABLE_ACC_PEAK_M_S2_FIELD_NUMBER: _ClassVar[int]
    TABLE_ACC_FUNDAMENTAL_M_S2_FIELD_NUMBER: _ClassVar[int]
    THD_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    direction: str
    frequency_hz: float
    measured: Quantities
    twin: Quantities
    table_acc_peak_m_s2: float
    table_acc_fundamental_m_s2: float
    thd: float
    run: str
    def __init__(self, index: int | None = ..., step: int | None = ..., direction: str | None = ..., frequency_hz: float | None = ..., measured: Quantities | _Mapping | None = ..., twin: Quantities | _Mapping | None = ..., table_acc_peak_m_s2: float | None = ..., table_acc_fundamental_m_s2: float | None = ..., thd: float | None = ..., run: str | None = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("index", "kind", "run", "text")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    kind: str
    text: str
    run: str
    def __init__(self, index: int | None = ..., kind: str | None = ..., text: str | None = ..., run: str | None = ...) -> None: ...

class Gap(_message.Message):
    __slots__ = ("channel", "count", "index", "reason", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    count: int
    channel: str
    reason: str
    run: str
    def __init__(self, index: int | None = ..., count: int | None = ..., channel: str | None = ..., reason: str | None = ..., run: str | None = ...) -> None: ...

class Fault(_message.Message):
    __slots__ = ("component", "from_index", "index", "reason", "run", "to_index")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COMPONENT_FIELD_NUMBER: _ClassVar[int]
    FROM_INDEX_FIELD_NUMBER: _ClassVar[int]
    TO_INDEX_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    component: str
    from_index: int
    to_index: int
    reason: str
    run: str
    def __init__(self, index: int | None = ..., component: str | None = ..., from_index: int | None = ..., to_index: int | None = ..., reason: str | None = ..., run: str | None = ...) -> None: ...

class Timing(_message.Message):
    __slots__ = ("blocks", "component", "cpu_share", "index", "max_ms", "missed", "p50_ms", "p99_ms", "run", "scheduler")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COMPONENT_FIELD_NUMBER: _ClassVar[int]
    P50_MS_FIELD_NUMBER: _ClassVar[int]
    P99_MS_FIELD_NUMBER: _ClassVar[int]
    MAX_MS_FIELD_NUMBER: _ClassVar[int]
    MISSED_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_FIELD_NUMBER: _ClassVar[int]
    CPU_SHARE_FIELD_NUMBER: _ClassVar[int]
    SCHEDULER_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    component: str
    p50_ms: float
    p99_ms: float
    max_ms: float
    missed: int
    blocks: int
    cpu_share: float
    scheduler: str
    run: str
    def __init__(self, index: int | None = ..., component: str | None = ..., p50_ms: float | None = ..., p99_ms: float | None = ..., max_ms: float | None = ..., missed: int | None = ..., blocks: int | None = ..., cpu_share: float | None = ..., scheduler: str | None = ..., run: str | None = ...) -> None: ...

class RunStop(_message.Message):
    __slots__ = ("index", "reason", "run", "states", "verdict")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    verdict: str
    reason: str
    states: _containers.RepeatedScalarFieldContainer[str]
    run: str
    def __init__(self, index: int | None = ..., verdict: str | None = ..., reason: str | None = ..., states: _Iterable[str] | None = ..., run: str | None = ...) -> None: ...
