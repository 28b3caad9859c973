from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Channel(_message.Message):
    __slots__ = ("name", "values")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    name: str
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: _Optional[str] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class Block(_message.Message):
    __slots__ = ("run", "stream", "index", "rate_hz", "channels", "step", "label", "cycle", "names", "values", "labels")
    RUN_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    NAMES_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    run: str
    stream: str
    index: int
    rate_hz: float
    channels: _containers.RepeatedCompositeFieldContainer[Channel]
    step: _containers.RepeatedScalarFieldContainer[int]
    label: _containers.RepeatedScalarFieldContainer[int]
    cycle: _containers.RepeatedScalarFieldContainer[int]
    names: _containers.RepeatedScalarFieldContainer[str]
    values: bytes
    labels: bytes
    def __init__(self, run: _Optional[str] = ..., stream: _Optional[str] = ..., index: _Optional[int] = ..., rate_hz: _Optional[float] = ..., channels: _Optional[_Iterable[_Union[Channel, _Mapping]]] = ..., step: _Optional[_Iterable[int]] = ..., label: _Optional[_Iterable[int]] = ..., cycle: _Optional[_Iterable[int]] = ..., names: _Optional[_Iterable[str]] = ..., values: _Optional[bytes] = ..., labels: _Optional[bytes] = ...) -> None: ...

class Step(_message.Message):
    __slots__ = ("index", "direction", "frequency_hz", "acceleration_m_s2")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    index: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float
    def __init__(self, index: _Optional[int] = ..., direction: _Optional[str] = ..., frequency_hz: _Optional[float] = ..., acceleration_m_s2: _Optional[float] = ...) -> None: ...

class RunStart(_message.Message):
    __slots__ = ("index", "run", "name", "source", "profile_toml", "rig_toml", "model_toml", "rate_hz", "block_samples", "channels", "steps", "planned_samples", "tare", "versions", "host", "started_at", "epoch_s", "predictions_every")
    class TareEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    class VersionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
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
    PREDICTIONS_EVERY_FIELD_NUMBER: _ClassVar[int]
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
    predictions_every: int
    def __init__(self, index: _Optional[int] = ..., run: _Optional[str] = ..., name: _Optional[str] = ..., source: _Optional[str] = ..., profile_toml: _Optional[str] = ..., rig_toml: _Optional[str] = ..., model_toml: _Optional[str] = ..., rate_hz: _Optional[float] = ..., block_samples: _Optional[int] = ..., channels: _Optional[_Iterable[str]] = ..., steps: _Optional[_Iterable[_Union[Step, _Mapping]]] = ..., planned_samples: _Optional[int] = ..., tare: _Optional[_Mapping[str, float]] = ..., versions: _Optional[_Mapping[str, str]] = ..., host: _Optional[str] = ..., started_at: _Optional[str] = ..., epoch_s: _Optional[float] = ..., predictions_every: _Optional[int] = ...) -> None: ...

class Params(_message.Message):
    __slots__ = ("index", "values", "reason", "run")
    class ValuesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    INDEX_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    values: _containers.ScalarMap[str, float]
    reason: str
    run: str
    def __init__(self, index: _Optional[int] = ..., values: _Optional[_Mapping[str, float]] = ..., reason: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class Comparison(_message.Message):
    __slots__ = ("index", "count", "channels", "measured_ss", "free_error_ss", "window_error_ss", "run")
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
    def __init__(self, index: _Optional[int] = ..., count: _Optional[int] = ..., channels: _Optional[_Iterable[str]] = ..., measured_ss: _Optional[_Iterable[float]] = ..., free_error_ss: _Optional[_Iterable[float]] = ..., window_error_ss: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Extremes(_message.Message):
    __slots__ = ("u_max", "u_min", "a_max", "a_min", "force_r", "force_l", "onsets_r", "onsets_l")
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
    def __init__(self, u_max: _Optional[float] = ..., u_min: _Optional[float] = ..., a_max: _Optional[float] = ..., a_min: _Optional[float] = ..., force_r: _Optional[float] = ..., force_l: _Optional[float] = ..., onsets_r: _Optional[_Iterable[int]] = ..., onsets_l: _Optional[_Iterable[int]] = ...) -> None: ...

class Cycle(_message.Message):
    __slots__ = ("index", "step", "cycle", "count", "measured", "twin", "run", "label")
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
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., cycle: _Optional[int] = ..., count: _Optional[int] = ..., measured: _Optional[_Union[Extremes, _Mapping]] = ..., twin: _Optional[_Union[Extremes, _Mapping]] = ..., run: _Optional[str] = ..., label: _Optional[int] = ...) -> None: ...

class Quantities(_message.Message):
    __slots__ = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l", "impacts_right", "impacts_left", "drift", "spread", "spread_a")
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
    SPREAD_A_FIELD_NUMBER: _ClassVar[int]
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
    spread_a: float
    def __init__(self, eta_d: _Optional[float] = ..., eta_a: _Optional[float] = ..., eta_r: _Optional[float] = ..., eta_l: _Optional[float] = ..., r_r: _Optional[float] = ..., r_l: _Optional[float] = ..., impacts_right: _Optional[_Iterable[int]] = ..., impacts_left: _Optional[_Iterable[int]] = ..., drift: _Optional[float] = ..., spread: _Optional[float] = ..., spread_a: _Optional[float] = ...) -> None: ...

class Point(_message.Message):
    __slots__ = ("index", "step", "direction", "frequency_hz", "measured", "twin", "table_acc_peak_m_s2", "table_acc_fundamental_m_s2", "thd", "run")
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
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., direction: _Optional[str] = ..., frequency_hz: _Optional[float] = ..., measured: _Optional[_Union[Quantities, _Mapping]] = ..., twin: _Optional[_Union[Quantities, _Mapping]] = ..., table_acc_peak_m_s2: _Optional[float] = ..., table_acc_fundamental_m_s2: _Optional[float] = ..., thd: _Optional[float] = ..., run: _Optional[str] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("index", "kind", "text", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    kind: str
    text: str
    run: str
    def __init__(self, index: _Optional[int] = ..., kind: _Optional[str] = ..., text: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class Gap(_message.Message):
    __slots__ = ("index", "count", "channel", "reason", "run")
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
    def __init__(self, index: _Optional[int] = ..., count: _Optional[int] = ..., channel: _Optional[str] = ..., reason: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class Fault(_message.Message):
    __slots__ = ("index", "component", "from_index", "to_index", "reason", "run")
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
    def __init__(self, index: _Optional[int] = ..., component: _Optional[str] = ..., from_index: _Optional[int] = ..., to_index: _Optional[int] = ..., reason: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class Timing(_message.Message):
    __slots__ = ("index", "component", "p50_ms", "p99_ms", "max_ms", "missed", "blocks", "cpu_share", "scheduler", "run")
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
    def __init__(self, index: _Optional[int] = ..., component: _Optional[str] = ..., p50_ms: _Optional[float] = ..., p99_ms: _Optional[float] = ..., max_ms: _Optional[float] = ..., missed: _Optional[int] = ..., blocks: _Optional[int] = ..., cpu_share: _Optional[float] = ..., scheduler: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class RunStop(_message.Message):
    __slots__ = ("index", "verdict", "reason", "states", "run")
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
    def __init__(self, index: _Optional[int] = ..., verdict: _Optional[str] = ..., reason: _Optional[str] = ..., states: _Optional[_Iterable[str]] = ..., run: _Optional[str] = ...) -> None: ...

class Check(_message.Message):
    __slots__ = ("index", "name", "channel", "value", "low", "high", "unit", "passed", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    PASSED_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    name: str
    channel: str
    value: float
    low: float
    high: float
    unit: str
    passed: bool
    run: str
    def __init__(self, index: _Optional[int] = ..., name: _Optional[str] = ..., channel: _Optional[str] = ..., value: _Optional[float] = ..., low: _Optional[float] = ..., high: _Optional[float] = ..., unit: _Optional[str] = ..., passed: _Optional[bool] = ..., run: _Optional[str] = ...) -> None: ...

class Response(_message.Message):
    __slots__ = ("index", "frequencies_hz", "gain", "phase_rad", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    FREQUENCIES_HZ_FIELD_NUMBER: _ClassVar[int]
    GAIN_FIELD_NUMBER: _ClassVar[int]
    PHASE_RAD_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    frequencies_hz: _containers.RepeatedScalarFieldContainer[float]
    gain: _containers.RepeatedScalarFieldContainer[float]
    phase_rad: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: _Optional[int] = ..., frequencies_hz: _Optional[_Iterable[float]] = ..., gain: _Optional[_Iterable[float]] = ..., phase_rad: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Level(_message.Message):
    __slots__ = ("index", "step", "demanded_m_s2", "measured_m_s2", "correction", "update", "accepted", "harmonics_m_s2", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DEMANDED_M_S2_FIELD_NUMBER: _ClassVar[int]
    MEASURED_M_S2_FIELD_NUMBER: _ClassVar[int]
    CORRECTION_FIELD_NUMBER: _ClassVar[int]
    UPDATE_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    HARMONICS_M_S2_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    demanded_m_s2: float
    measured_m_s2: float
    correction: float
    update: int
    accepted: bool
    harmonics_m_s2: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., demanded_m_s2: _Optional[float] = ..., measured_m_s2: _Optional[float] = ..., correction: _Optional[float] = ..., update: _Optional[int] = ..., accepted: _Optional[bool] = ..., harmonics_m_s2: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Decided(_message.Message):
    __slots__ = ("index", "step", "direction", "frequency_hz", "acceleration_m_s2", "reason", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float
    reason: str
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., direction: _Optional[str] = ..., frequency_hz: _Optional[float] = ..., acceleration_m_s2: _Optional[float] = ..., reason: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class SweepLevel(_message.Message):
    __slots__ = ("index", "step", "frequency_hz", "reference_m_s2", "demanded_m_s2", "measured_m_s2", "correction", "limited_by", "channels", "amplitudes", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_M_S2_FIELD_NUMBER: _ClassVar[int]
    DEMANDED_M_S2_FIELD_NUMBER: _ClassVar[int]
    MEASURED_M_S2_FIELD_NUMBER: _ClassVar[int]
    CORRECTION_FIELD_NUMBER: _ClassVar[int]
    LIMITED_BY_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    AMPLITUDES_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    frequency_hz: float
    reference_m_s2: float
    demanded_m_s2: float
    measured_m_s2: float
    correction: float
    limited_by: str
    channels: _containers.RepeatedScalarFieldContainer[str]
    amplitudes: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., frequency_hz: _Optional[float] = ..., reference_m_s2: _Optional[float] = ..., demanded_m_s2: _Optional[float] = ..., measured_m_s2: _Optional[float] = ..., correction: _Optional[float] = ..., limited_by: _Optional[str] = ..., channels: _Optional[_Iterable[str]] = ..., amplitudes: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Orbit(_message.Message):
    __slots__ = ("index", "step", "frequency_hz", "acceleration_m_s2", "amplitude_m", "u_m", "feedback_m", "noise_m", "command_m", "periods", "updates", "stable", "multiplier", "accepted", "reason", "run", "multiplier_sd")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_S2_FIELD_NUMBER: _ClassVar[int]
    AMPLITUDE_M_FIELD_NUMBER: _ClassVar[int]
    U_M_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_M_FIELD_NUMBER: _ClassVar[int]
    NOISE_M_FIELD_NUMBER: _ClassVar[int]
    COMMAND_M_FIELD_NUMBER: _ClassVar[int]
    PERIODS_FIELD_NUMBER: _ClassVar[int]
    UPDATES_FIELD_NUMBER: _ClassVar[int]
    STABLE_FIELD_NUMBER: _ClassVar[int]
    MULTIPLIER_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    MULTIPLIER_SD_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    frequency_hz: float
    acceleration_m_s2: float
    amplitude_m: float
    u_m: _containers.RepeatedScalarFieldContainer[float]
    feedback_m: _containers.RepeatedScalarFieldContainer[float]
    noise_m: float
    command_m: float
    periods: int
    updates: int
    stable: bool
    multiplier: float
    accepted: bool
    reason: str
    run: str
    multiplier_sd: float
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., frequency_hz: _Optional[float] = ..., acceleration_m_s2: _Optional[float] = ..., amplitude_m: _Optional[float] = ..., u_m: _Optional[_Iterable[float]] = ..., feedback_m: _Optional[_Iterable[float]] = ..., noise_m: _Optional[float] = ..., command_m: _Optional[float] = ..., periods: _Optional[int] = ..., updates: _Optional[int] = ..., stable: _Optional[bool] = ..., multiplier: _Optional[float] = ..., accepted: _Optional[bool] = ..., reason: _Optional[str] = ..., run: _Optional[str] = ..., multiplier_sd: _Optional[float] = ...) -> None: ...

class Trip(_message.Message):
    __slots__ = ("index", "decided", "kind", "channel", "value", "limit", "text", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    DECIDED_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    decided: int
    kind: str
    channel: str
    value: float
    limit: float
    text: str
    run: str
    def __init__(self, index: _Optional[int] = ..., decided: _Optional[int] = ..., kind: _Optional[str] = ..., channel: _Optional[str] = ..., value: _Optional[float] = ..., limit: _Optional[float] = ..., text: _Optional[str] = ..., run: _Optional[str] = ...) -> None: ...

class Agreement(_message.Message):
    __slots__ = ("index", "step", "cycle", "count", "channels", "error", "band", "flight", "right", "left", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    BAND_FIELD_NUMBER: _ClassVar[int]
    FLIGHT_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    cycle: int
    count: int
    channels: _containers.RepeatedScalarFieldContainer[str]
    error: _containers.RepeatedScalarFieldContainer[float]
    band: _containers.RepeatedScalarFieldContainer[float]
    flight: _containers.RepeatedScalarFieldContainer[float]
    right: _containers.RepeatedScalarFieldContainer[float]
    left: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., cycle: _Optional[int] = ..., count: _Optional[int] = ..., channels: _Optional[_Iterable[str]] = ..., error: _Optional[_Iterable[float]] = ..., band: _Optional[_Iterable[float]] = ..., flight: _Optional[_Iterable[float]] = ..., right: _Optional[_Iterable[float]] = ..., left: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Estimate(_message.Message):
    __slots__ = ("index", "step", "names", "values", "sd", "drift", "drift_sd", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    NAMES_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    SD_FIELD_NUMBER: _ClassVar[int]
    DRIFT_FIELD_NUMBER: _ClassVar[int]
    DRIFT_SD_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    names: _containers.RepeatedScalarFieldContainer[str]
    values: _containers.RepeatedScalarFieldContainer[float]
    sd: _containers.RepeatedScalarFieldContainer[float]
    drift: _containers.RepeatedScalarFieldContainer[float]
    drift_sd: _containers.RepeatedScalarFieldContainer[float]
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., names: _Optional[_Iterable[str]] = ..., values: _Optional[_Iterable[float]] = ..., sd: _Optional[_Iterable[float]] = ..., drift: _Optional[_Iterable[float]] = ..., drift_sd: _Optional[_Iterable[float]] = ..., run: _Optional[str] = ...) -> None: ...

class Ahead(_message.Message):
    __slots__ = ("index", "step", "direction", "frequency_hz", "kind", "jump_hz", "low_hz", "high_hz", "run")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    FREQUENCY_HZ_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    JUMP_HZ_FIELD_NUMBER: _ClassVar[int]
    LOW_HZ_FIELD_NUMBER: _ClassVar[int]
    HIGH_HZ_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    index: int
    step: int
    direction: str
    frequency_hz: float
    kind: str
    jump_hz: float
    low_hz: float
    high_hz: float
    run: str
    def __init__(self, index: _Optional[int] = ..., step: _Optional[int] = ..., direction: _Optional[str] = ..., frequency_hz: _Optional[float] = ..., kind: _Optional[str] = ..., jump_hz: _Optional[float] = ..., low_hz: _Optional[float] = ..., high_hz: _Optional[float] = ..., run: _Optional[str] = ...) -> None: ...

class PredictionHash(_message.Message):
    __slots__ = ("index", "count", "digest", "run", "free", "window")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    FREE_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    index: int
    count: int
    digest: bytes
    run: str
    free: _containers.RepeatedScalarFieldContainer[float]
    window: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, index: _Optional[int] = ..., count: _Optional[int] = ..., digest: _Optional[bytes] = ..., run: _Optional[str] = ..., free: _Optional[_Iterable[float]] = ..., window: _Optional[_Iterable[float]] = ...) -> None: ...
