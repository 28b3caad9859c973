"""Imperfections of instruments and set-up that a ground-truth file can state.

    [[imperfections]]
    id = "anti_alias_filter"
    form = "bessel"             # default: first form of the id
    channel = "mass_acc_m_s2"   # default: each sensor on which it can act
    parameters = { order = 4, corner_hz = 200.0 }
    [[imperfections]]
    id = "load_sharing"
    side = "right"              # default: both sides
    parameters = { share = 0.53 }

An entry with a channel or side replaces, there, the one without. Every parameter has a default; a
size is absent at its vanishing value, and each entry must state a size. `laboratory.py` applies
them between the true values and the converter. (J) in a source: judgement, no figure was found.

`HiddenEntry` is the base of all entries of a ground-truth file, effects and imperfections.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, Number
from table_io.errors import InputError, suggest


class HiddenParameter(NamedTuple):
    """Parameter of an effect or imperfection in SI; at `vanishing` it is absent.

    `vanishing` None: the parameter only shapes it. `default` None: it must be given. `typical` and
    `bad` are sizes that occur in practice; only imperfections have a `bad` one.
    """

    name: str
    unit: str
    low: float
    high: float
    vanishing: float | None
    typical: float
    default: float | None = None
    bad: float | None = None
    is_integer: bool = False


def find_parameter_faults(
    parameters: Sequence[HiddenParameter], given: Mapping[str, float]
) -> list[str]:
    """List a message for each unknown, missing, fractional or out-of-range parameter."""
    known_names = [parameter.name for parameter in parameters]
    faults = [
        f"no parameter {name!r}; {suggest(name, known_names)}"
        for name in given
        if name not in known_names
    ]
    for parameter in parameters:
        value = given.get(parameter.name, parameter.default)
        allowed = f"allowed: {parameter.low:g} to {parameter.high:g} {parameter.unit}".rstrip()
        if value is None:
            faults.append(f"lacks {parameter.name!r}; add it, {allowed}")
        elif not parameter.low <= value <= parameter.high:
            faults.append(f"{parameter.name} = {value:g}; {allowed}")
        elif parameter.is_integer and value != round(value):
            faults.append(f"{parameter.name} = {value:g}; {allowed}, a whole number")
    return faults


class HiddenDefinition(Protocol):
    """What an entry can state: the parameters of an id in one form."""

    @property
    def parameters(self) -> tuple[HiddenParameter, ...]: ...


class HiddenEntry(ConfigModel):
    """Entry of a ground-truth file.

    A subclass declares `parameters` as its last field, because their validation needs the others;
    they are completed with defaults. `definitions` are by (id, form); the first form of an id is
    its default.
    """

    noun: ClassVar[str]
    definitions: ClassVar[Mapping[tuple[str, str], HiddenDefinition]]

    id: str = Field(description="Name of the effect or imperfection.")
    form: str = Field("", validate_default=True, description="Empty: first form of the id.")
    channel: str | None = Field(
        None, description="Channel on which it acts, for those of one channel."
    )

    @classmethod
    def find_faults(
        cls, definition: Any, given: Mapping[str, float], place: Mapping[str, Any]
    ) -> list[str]:
        """List a message for each other fault of the parameters and the place of an entry."""
        raise NotImplementedError

    def check_channel(self, allowed: Sequence[str], problem: str) -> None:
        """Raise InputError if the entry states a channel that is not among these."""
        if self.channel is not None and self.channel not in allowed:
            raise InputError(
                problem,
                where=f"ground truth, {self.noun} {self.id}",
                key="channel",
                value=self.channel,
                allowed=", ".join(allowed),
            )

    @field_validator("id")
    @classmethod
    def _check_id(cls, name: str) -> str:
        ids = list(dict.fromkeys(known for known, _ in cls.definitions))
        if name not in ids:
            raise InputError(f"{cls.noun} {name!r} is unknown", remedy=suggest(name, ids))
        return name

    @field_validator("form")
    @classmethod
    def _check_form(cls, form: str, info: ValidationInfo) -> str:
        forms = [known for name, known in cls.definitions if name == info.data.get("id")]
        if not forms:
            return form
        if form and form not in forms:
            raise InputError(f"{info.data['id']} has no form {form!r}", remedy=suggest(form, forms))
        return form or forms[0]

    @field_validator("parameters", check_fields=False)
    @classmethod
    def _complete_parameters(
        cls, given: dict[str, float], info: ValidationInfo
    ) -> dict[str, float]:
        definition = cls.definitions.get((info.data.get("id", ""), info.data.get("form", "")))
        if definition is None:
            return given
        faults = find_parameter_faults(definition.parameters, given)
        faults += cls.find_faults(definition, given, info.data)
        if faults:
            raise ValueError(f"{info.data['id']}: " + "; ".join(faults))
        return {
            parameter.name: given.get(parameter.name, parameter.default or 0.0)
            for parameter in definition.parameters
        }


INF = float("inf")
SIDES: tuple[Literal["right", "left"], ...] = ("right", "left")
DISPLACEMENTS = ("displacement", "relative_displacement")
ACCELERATIONS = ("acceleration",)
ALL_QUANTITIES = ("*",)
SIZE_SCATTER = 0.2  # standard deviation of the log of drawn sizes


class ImperfectionDefinition(NamedTuple):
    """Definition of an imperfection in one form.

    `quantities` it acts on, of sensors; empty: it has no channel. `has_side`: it is of one side.
    `mismatch`: relative scatter between channels or sides of a typical laboratory.
    """

    id: str
    form: str
    quantities: tuple[str, ...]
    has_side: bool
    parameters: tuple[HiddenParameter, ...]
    meaning: str
    source: str
    mismatch: float = SIZE_SCATTER


def _size(
    name: str,
    unit: str,
    low: float,
    high: float,
    vanishing: float,
    typical: float,
    bad: float,
    is_integer: bool = False,
) -> HiddenParameter:
    """Return a parameter that vanishes where it is not given."""
    return HiddenParameter(name, unit, low, high, vanishing, typical, vanishing, bad, is_integer)


def _shape(
    name: str, unit: str, low: float, high: float, default: float, is_integer: bool = False
) -> HiddenParameter:
    """Return a parameter that only shapes the imperfection."""
    return HiddenParameter(name, unit, low, high, None, default, default, default, is_integer)


def _phase(name: str) -> HiddenParameter:
    """Return a phase angle."""
    return _shape(name, "rad", -math.tau, math.tau, 0.0)


_FILTER = (
    _size("corner_hz", "Hz", 1.0, INF, INF, 200.0, 100.0),
    _shape("order", "", 1, 8, 4, is_integer=True),
)
_FILTER_SOURCE = (
    "NI 54462: SAR cards have none, external filters of order 3 to 8; 100 Hz on all channels at "
    "3 kHz in the Dyke MR damper record; Texys AC-CAP: MEMS 100 or 400 Hz"
)
IMPERFECTION_DEFINITIONS: tuple[ImperfectionDefinition, ...] = (
    ImperfectionDefinition("load_sharing", "linear", (), True,
        (_size("share", "", 0.0, 1.0, 0.5, 0.52, 0.6),
         _size("share_per_m", "1/m", -50.0, 50.0, 0.0, 0.5, 3.0)),
        "first cell reads (share + share_per_m u) of the contact force, the second the rest",
        "(J) cells d apart, contact off centre by e: 0.5 +- e/d; 2 mm and 10 mm of 100 mm"),
    ImperfectionDefinition("plate_mass", "rigid", (), True,
        (_size("mass", "kg", 0.0, 100.0, 0.0, 2.0, 10.0),),
        "plate between bumper and cells, moving with the table: the right cells read N_R - mass "
        "y'', the left ones N_L + mass y'', each cell half of the inertia",
        "(J) a steel plate of 160 x 160 x 10 mm has 2 kg"),
    ImperfectionDefinition("anti_alias_filter", "butterworth", ALL_QUANTITIES, False, _FILTER,
        "low-pass of this order, -3 dB at corner_hz, on signal and noise", _FILTER_SOURCE, 0.02),
    ImperfectionDefinition("anti_alias_filter", "bessel", ALL_QUANTITIES, False, _FILTER,
        "low-pass of this order, -3 dB at corner_hz, on signal and noise", _FILTER_SOURCE, 0.02),
    ImperfectionDefinition("highpass", "first_order", ACCELERATIONS, False,
        (_size("corner_hz", "Hz", 0.0, 10.0, 0.0, 0.16, 0.5),),
        "low cut of an IEPE accelerometer: s / (s + 2 pi corner_hz)",
        "The Modal Shop: 5 % point at 0.5 Hz, so -3 dB at 0.16 Hz; bad: 5 % point at 1.5 Hz"),
    ImperfectionDefinition("channel_skew", "scan", (), False,
        (_size("skew", "s", 0.0, 1e-3, 0.0, 2e-5, 1.25e-4),),
        "channels are sampled one after another in the order of the rig file, the last on time",
        "NI kA00Z0000019PBzSAM: 1 / fastest conversion + 10 us; bad: 8 channels spread over 1 ms"),
    ImperfectionDefinition("hum", "harmonics", ALL_QUANTITIES, False,
        (_size("rms", "unit of the channel", 0.0, 1e4, 0.0, 0.0, 0.0),
         _size("rms_over_noise", "", 0.0, 1e3, 0.0, 1.0, 10.0),
         _shape("frequency", "Hz", 1.0, 1000.0, 50.02),
         _shape("harmonic_2", "", 0.0, 10.0, 0.05), _shape("harmonic_3", "", 0.0, 10.0, 0.3),
         _shape("harmonic_5", "", 0.0, 10.0, 0.1), _phase("phase"),
         _phase("phase_2"), _phase("phase_3"), _phase("phase_5")),
        "sum of sines of this rms in all, harmonics relative to the fundamental; rms + "
        "rms_over_noise x noise of the sensor",
        "(J) 0.1 to 1 mV on +-10 V, so about the noise; ground loop 5 to 20 mV"),
    ImperfectionDefinition("one_over_f", "half_order", ALL_QUANTITIES, False,
        (_size("corner_hz", "Hz", 0.0, 1000.0, 0.0, 1.0, 100.0),),
        "noise added with the density white x corner_hz / f, from 1 mHz on",
        "ADXL345, ADXL355: below about 1 Hz (J); Levinzon 2017: IEPE 100 Hz and above"),
    ImperfectionDefinition("drift", "linear", ALL_QUANTITIES, False,
        (_size("offset_per_h", "unit of the channel/h", -1e4, 1e4, 0.0, 0.0, 0.0),
         _size("offset_share_per_h", "1/h", -0.1, 0.1, 0.0, 1e-4, 1e-3),
         _size("warm_up", "unit of the channel", -1e4, 1e4, 0.0, 0.0, 0.0),
         _size("warm_up_share", "", -0.1, 0.1, 0.0, 1e-4, 1e-3),
         _size("gain_per_h", "1/h", -0.1, 0.1, 0.0, 1e-4, 1e-3),
         _shape("warm_up_time", "s", 1.0, 1e5, 1200.0)),
        "offset: rate t + warm_up (1 - exp(-t / warm_up_time)); gain: 1 + gain_per_h t; shares are "
        "of the full scale, t from sample 0",
        "HBM C10 0.0075 % FS/K (older: 0.05), optoNCDT 0.01 to 0.03 % FS/K, ADXL350 0.17 to 0.31 "
        "mg/K and 0.01 %/K, at 1 to 2 K/h; ILD1402: warm-up of 20 min"),
    ImperfectionDefinition("laser_nonlinearity", "chebyshev", DISPLACEMENTS, False,
        (_size("share", "", -0.05, 0.05, 0.0, 8e-4, 2e-3),
         _size("even_share", "", -0.05, 0.05, 0.0, 4e-4, 1e-3)),
        "error over full scale: share T7(s) + even_share (T6(s) + 1) / 2, s = position over full "
        "scale (T: Chebyshev polynomials); 0 at position 0",
        "optoNCDT 1700-20: 0.08 to 0.2 % FS; ILD1402 manual: 0.015 % in a sensor's own protocol"),
    ImperfectionDefinition("light_spot", "gaussian", DISPLACEMENTS, False,
        (_size("rms", "m", 0.0, 1e-3, 0.0, 1.5e-6, 5e-6),
         _shape("correlation_length", "m", 1e-5, 0.1, 2e-4)),
        "fixed random profile over position, correlation exp(-d^2 / (2 correlation_length^2))",
        "optoNCDT 1700-20: 1.5 um; 5 um and more on a rough surface; Dorsch et al. 1994: speckle"),
    ImperfectionDefinition("quantisation", "uniform", ALL_QUANTITIES, False,
        (_size("bits", "", 4, 32, 32, 16, 12, is_integer=True),),
        "effective bits over the range of the sensor, where fewer than those of the rig file",
        "NI 621x manual: 16 bits; bad: 12 bits, or 6 % of the range of 16 bits used"),
    ImperfectionDefinition("cross_axis", "resonant", ACCELERATIONS, False,
        (_size("share", "", -1.0, 1.0, 0.0, 0.02, 0.05),
         _shape("vertical_share", "", -1.0, 1.0, 0.05), _shape("frequency", "Hz", 1.0, 500.0, 25.0),
         _shape("damping_ratio", "", 1e-3, 0.9, 0.05), _shape("lever", "m", -10.0, 10.0, 0.5)),
        "share of the vertical acceleration, that is vertical_share of the table's plus lever x "
        "pitch acceleration, both through a resonance, plus g (cos(pitch) - 1)",
        "Endevco: 1 to 5 %, ADXL350 +-3 %; vertical motion of the table (J)"),
    ImperfectionDefinition("mounting_resonance", "bracket", ACCELERATIONS, False,
        (_size("frequency", "Hz", 5.0, INF, INF, 5000.0, 300.0),
         _shape("damping_ratio", "", 1e-3, 0.9, 0.025)),
        "absolute acceleration of the sensor on a bracket with this resonance",
        "mmf.de: adhesive 5 kHz; sheet metal or plastic bracket 100 to 400 Hz, Q 10 to 30 (J)"),
    ImperfectionDefinition("cable", "whip", ACCELERATIONS, False,
        (_size("error_per_n", "m/s2/N", -0.1, 0.1, 0.0, 1e-6, 1e-4),
         _shape("decay_time", "s", 1e-3, 10.0, 0.1)),
        "an impact of contact force F adds error_per_n F s T / ((1 + s T) (1 + s T / 10)), "
        "T = decay_time, F = right + left",
        "mmf.de, Ludeca: triboelectric bumps of mV at low frequency; 10 mg at 1 kN (J)"),
    ImperfectionDefinition("table_pitch", "rigid", (), False,
        (_size("per_acceleration", "rad s2/m", -3e-3, 3e-3, 0.0, 1e-5, 2e-4),
         _size("per_travel", "rad/m", -10.0, 10.0, 0.0, 1e-3, 1e-2)),
        "pitch = per_acceleration y'' + per_travel y; the accelerometers read + g sin(pitch), the "
        "mass feels -M g sin(pitch)",
        "(J) 0.1 mrad per g; bad: 2 mrad per g, 10 urad/mm of rail"),
    ImperfectionDefinition("mass_reading", "ratio", (), False,
        (_size("ratio", "", 0.5, 2.0, 1.0, 1.001, 1.01),),
        "true mass = stated mass x ratio", "(J) class of a scale: 0.1 %; bad: 1 %"),
    ImperfectionDefinition("gap_reading", "offset", (), True,
        (_size("offset", "m", -0.015, 0.015, 0.0, 5e-5, 3e-4),),
        "true gap = stated gap + offset", "(J) feeler gauge: 0.05 mm; bad: 0.3 mm"),
    ImperfectionDefinition("time_base", "one_clock", (), False,
        (_size("deviation", "ppm", -1e4, 1e4, 0.0, 50.0, 100.0),),
        "true rate = stated rate x (1 + 1e-6 deviation), of drive and acquisition alike",
        "NI USB-621x, cDAQ-9171: 50 ppm of the sample rate; bad: 100 ppm (J)"),
)  # fmt: skip
# By (id, form); the first form of an id is its default.
IMPERFECTION_BY_ID: dict[tuple[str, str], ImperfectionDefinition] = {
    (definition.id, definition.form): definition for definition in IMPERFECTION_DEFINITIONS
}
IMPERFECTION_IDS = tuple(dict.fromkeys(definition.id for definition in IMPERFECTION_DEFINITIONS))


class Imperfection(HiddenEntry):
    """One entry of [[imperfections]]; `parameters` is completed with defaults."""

    noun = "imperfection"
    definitions = IMPERFECTION_BY_ID

    channel: str | None = Field(None, description="None: each sensor on which it can act.")
    side: Literal["right", "left"] | None = Field(None, description="None: both sides.")
    parameters: dict[str, Number] = Field(description="Parameters of the imperfection, in SI.")

    @classmethod
    def find_faults(
        cls, definition: ImperfectionDefinition, given: Mapping[str, float],
        place: Mapping[str, Any],
    ) -> list[str]:  # fmt: skip
        faults = []
        if not definition.quantities and place.get("channel") is not None:
            faults.append("has no channel; leave it out")
        if not definition.has_side and place.get("side") is not None:
            faults.append("has no side; leave it out")
        sizes = [p.name for p in definition.parameters if p.vanishing is not None]
        if not any(name in given for name in sizes):
            faults.append(f"states no size; add {' or '.join(sizes)}")
        return faults

    @property
    def definition(self) -> ImperfectionDefinition:
        return IMPERFECTION_BY_ID[self.id, self.form]

    @property
    def place(self) -> str | None:
        """Channel or side on which it acts; None if on all."""
        return self.channel or self.side

    @property
    def is_absent(self) -> bool:
        """True if every size is at its vanishing value."""
        return all(
            parameter.vanishing in (None, self.parameters[parameter.name])
            for parameter in self.definition.parameters
        )


def resolve_sides(
    imperfections: Iterable[Imperfection], imperfection_id: str
) -> dict[str, dict[str, float]]:
    """Return the parameters of an imperfection by side; an entry with a side wins."""
    return {
        side: entry.parameters
        for entry in sorted(imperfections, key=lambda entry: entry.side is not None)
        if entry.id == imperfection_id
        for side in SIDES
        if entry.side in (None, side)
    }


def acts_on(definition: ImperfectionDefinition, quantity: str) -> bool:
    """Return whether an imperfection can act on a sensor of this quantity."""
    return definition.quantities == ALL_QUANTITIES or quantity in definition.quantities
