"""Text of a model file and of the effect files that it names, from a fit."""

import math
from collections.abc import Mapping, Sequence

from table_io.config.base import format_toml
from twin.discovery.least_squares import FitResult
from twin.discovery.nuisances import MAX_SIZE, TYPICAL_GAIN
from twin.discovery.parameters import INPUT_GAIN, BaseKey, EffectKey, GapKey, SlipKey
from twin.evidence.linear import INTERVAL_SIGMA
from twin.laws.effect import Effect
from twin.laws.effect_file import format_effect_file
from twin.model.model import SENSOR_CHANNELS
from twin.model.parameters import Parameters

MIN_GAP_ERROR_M = 1e-6  # smaller gap corrections are not reported


def _is_input_gain_off(fit: FitResult) -> bool:
    """Return True if the whole interval of the gain of the table's sensor is off by too much."""
    half = INTERVAL_SIGMA * fit.interval_error(INPUT_GAIN)
    return abs(fit.parameters.values[INPUT_GAIN] - 1.0) - half > MAX_SIZE * TYPICAL_GAIN


def format_fitted_model(
    fit: FitResult,
    title: str,
    citation: str,
    fitted_on: str,
    provisional: str = "",
    named: Sequence[str] = (),
) -> tuple[str, list[str]]:
    """Return (text of a model file, notes on what it omits); gaps belong to the test profiles.

    `provisional` is the reason why the model is not to be trusted yet, if there is one, `named` are
    the effects that were added.
    """
    omitted = []
    kept: dict[tuple[str, str], dict[str, float]] = {}
    effects: dict[tuple[str, str], dict[str, float]] = {}
    for key, value in fit.parameters.values.items():
        if isinstance(key, EffectKey):
            effects.setdefault((key.effect, key.channel), {})[key.name] = value
    for (effect, channel), values in effects.items():
        if channel and channel not in SENSOR_CHANNELS:
            # gain and offset of an input are fitted in every log without another accelerometer
            is_off = EffectKey(effect, "gain", channel) == INPUT_GAIN and _is_input_gain_off(fit)
            if is_off or f"{effect}.{channel}" in named:
                omitted.append(
                    f"{effect}.{channel}: not in the model file, because the twin is driven by "
                    "this channel and does not predict it; repair or calibrate the sensor"
                )
            continue
        kept[effect, channel] = values
    intervals: dict[str, tuple[float, float]] = {}
    for free in fit.free:
        if (
            isinstance(free.key, BaseKey | EffectKey | SlipKey)
            and 0 < fit.interval_error(free.key) < math.inf
        ):
            value = fit.values[free.key]
            half = INTERVAL_SIGMA * fit.interval_error(free.key)
            intervals[free.name] = value - half, value + half
    gaps = {key: value for key, value in fit.values.items() if isinstance(key, GapKey)}
    if any(
        abs(v) > max(INTERVAL_SIGMA * fit.std_errors[k], MIN_GAP_ERROR_M) for k, v in gaps.items()
    ):
        differences = ", ".join(f"{1e3 * v:+.3f} mm" for v in gaps.values())
        omitted.append(
            f"correct the gaps in the test profile of each log: each side differs by {differences}"
        )
    texts = {
        "title": title,
        "citation": citation,
        "fitted_on": fitted_on,
        "provisional": provisional,
    }
    files = {
        effect.id: effect_file_name(effect)
        for effect in fit.parameters.effects.values()
        if effect.is_of_file
    }
    base = fit.parameters.to_model().base
    return format_model_toml(texts, base, kept, intervals, files), omitted


def format_model_toml(
    texts: Mapping[str, str],
    base: Parameters,
    effects: Mapping[tuple[str, str], Mapping[str, float]],
    intervals: Mapping[str, tuple[float, float]],
    files: Mapping[str, str] | None = None,
) -> str:
    """Return the text of a model file: `texts` by key, without an empty `provisional`.

    `effects` are values by (effect, channel), `intervals` of 95 % by parameter, `files` the names
    of the effect files by effect.
    """
    sources = {effect: {"file": name} for effect, name in (files or {}).items()}
    rows = [
        {
            **sources.get(effect, {"id": effect}),
            "parameters": {**values, **({"channel": channel} if channel else {})},
        }
        for (effect, channel), values in effects.items()
    ]
    content = {
        **{key: text for key, text in texts.items() if text or key != "provisional"},
        "base": {
            "stiffness_n_m": base.stiffness,
            "damping_n_s_m": base.damping,
            "bumper_stiffness_n_m": base.bumper_stiffness_r,
            "bumper_damping_n_s_m": base.bumper_damping_r,
        },
        **({"effects": rows} if rows else {}),
        "intervals": dict(intervals),
    }
    return format_toml(content)


def effect_file_name(effect: Effect) -> str:
    """Return the name of the effect file that a model file refers to."""
    return f"{effect.id}.toml"


def list_effect_files(fit: FitResult, laws: Sequence[Effect] = ()) -> dict[str, str]:
    """Return the texts by name of the effect files of a fitted model; `laws` describe new ones."""
    described = {law.id: law for law in laws}
    return {
        effect_file_name(effect): format_effect_file(described.get(effect.id, effect))
        for effect in fit.parameters.effects.values()
        if effect.is_of_file
        and any(
            isinstance(key, EffectKey) and key.effect == effect.id for key in fit.parameters.values
        )
    }
