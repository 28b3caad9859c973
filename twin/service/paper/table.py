"""The paper reports / the model gives / agrees or departs: one row a statement, each computed.

A row's verdict follows from its numbers by the rule that it states; nothing is tuned to agree.
"""

from collections.abc import Callable, Iterator

import numpy as np

from twin.model.parameters import resonance
from twin.service.paper import findings
from twin.service.paper.cases import curve
from twin.service.paper.rows import AGREES, CLOSE, DEPARTS, IN_KIND, NONE, Row, Values
from twin.service.paper.small_gaps import beyond, softening, zero
from twin.service.paper.study import CHAOS_HZ, COEXISTING_HZ, IRREGULAR_HZ, SECONDARY_HZ, Study


def table(found: Study) -> list[Row]:
    """Every row, in the order of the paper."""
    parts: tuple[Callable[[Study], Iterator[Row]], ...] = (
        _free_flight, _hardening, _trends, _coexistence, _secondary, _irregular, _chaos, zero,
        softening, beyond,
    )  # fmt: skip
    return [row for part in parts for row in part(found)]


def _free_flight(found: Study) -> Iterator[Row]:
    case = found.cases["G∞"]
    u, a, hz = resonance(case.parameters, case.acceleration)
    how = "continuous in frequency"
    if not found.exact:
        hz, how = found.slow["G∞"].peak_hz, "its linear part's, and the resonance by slow passage"
    u_scale = case.scale[0]
    f, eta = curve(case.points, "twin", "forward", "eta_d")
    yield Row(
        "free_flight", "Free flight", "resonance at about 1.3 Hz",
        f"{hz:.3f} Hz, u* = {1e3 * u:.3f} mm, a* = {a:.3f} m/s² ({how}); "
        f"{1e3 * u_scale * eta.max():.2f} mm at {f[eta.argmax()]:g} Hz on the 0.1 Hz grid",
        AGREES if abs(hz / 1.3 - 1) < CLOSE else DEPARTS,
        "resonance within 5 %. Every η here is divided by the continuous u*, a*. The real damper "
        "is nonlinear: off resonance the experiment lies above the model",
        {"resonance_hz": hz, "u_star_mm": 1e3 * u, "a_star_m_s2": a,
         "grid_u_max_mm": float(1e3 * u_scale * eta.max()), "grid_hz": float(f[eta.argmax()])},
    )  # fmt: skip


def _hardening(found: Study) -> Iterator[Row]:
    for name in ("G30", "G16", "G10"):
        fold = found.folds[name]
        right = fold is not None and fold.kind == "right"
        down, up = (fold.forward_hz, fold.backward_hz) if fold else (np.nan, np.nan)
        yield Row(
            name.lower(), name, "jumps and a right hysteresis",
            f"down-jump at {down:.3f} Hz, up-jump at {up:.3f} Hz ({fold.how})" if fold else NONE,
            AGREES if right else DEPARTS,
            "the forward branch is the larger between two jumps",
            {"down_hz": down, "up_hz": up},
        )  # fmt: skip
    fold, said = found.folds["G4"], "3.4 Hz lies inside the right hysteresis"
    rule = "3.4 Hz lies between the jumps"
    if fold is None:
        yield Row("g4", "G4", said, NONE, DEPARTS, rule)
        return
    graze = findings.graze_hz(found.cases["G4"], found.slow["G4"])
    last = found.cases["G4"].tests[-1]
    f, hits = curve(last.points, "twin", "forward", "eta_r")
    passed = float(f[hits > 0].max())
    inside = fold.backward_hz < COEXISTING_HZ < fold.forward_hz and fold.kind == "right"
    name = "fold" if found.exact else "jump"
    yield Row(
        "g4", "G4", said,
        f"{name} down {fold.forward_hz:.3f} Hz, graze {graze:.3f} Hz, {name} up "
        f"{fold.backward_hz:.3f} Hz ({fold.how}); in ten-cycle steps the forward sweep still "
        f"impacts at {passed:g} Hz",
        AGREES if inside else DEPARTS, rule,
        {"fold_down_hz": fold.forward_hz, "graze_hz": graze, "fold_up_hz": fold.backward_hz,
         "passage_from_hz": passed, "passage_to_hz": passed + last.profile.sweep.step_hz},
    )  # fmt: skip


def _trends(found: Study) -> Iterator[Row]:
    names = ("G30", "G16", "G10", "G4", "G0", "G-1")
    d, a = (
        [
            float(max(one.max() for one in getattr(found.slow[name], what).values()))
            for name in names
        ]
        for what in ("eta_d", "eta_a")
    )
    yield Row(
        "displacement_trend", "G30 to G-1", "the largest η_d falls as the gap falls",
        "largest η_d " + ", ".join(f"{size:.3f}" for size in d),
        AGREES if all(np.diff(d) < 0) else DEPARTS,
        "each is below the one before, from G30 to G-1 (slow passage)", {"eta_d": d},
    )  # fmt: skip
    top = int(np.argmax(a))
    yield Row(
        "acceleration_trend", "G30 to G-1", "the largest η_a first rises, then falls",
        "largest η_a " + ", ".join(f"{size:.2f}" for size in a) + f": greatest at {names[top]}",
        AGREES if top > 0 and all(np.diff(a[top:]) < 0) else DEPARTS,
        "greatest neither at the first nor at the last of them, falling after it", {"eta_a": a},
    )  # fmt: skip


def _coexistence(found: Study) -> Iterator[Row]:
    both = findings.coexisting(found.cases["G4"], found.slow["G4"], COEXISTING_HZ)
    said = 'two solutions; the unstable third "could not be obtained"'
    rule = "two stable motions, and Newton on the one-period map finds the third between them"
    if both is None:
        yield Row("g4_coexisting", "G4, 3.4 Hz", said, "one solution", DEPARTS, rule)
        return
    top, bottom = 1e3 * both.forward_m, 1e3 * both.backward_m
    text = f"{top:.3f} mm impacting, {bottom:.3f} mm in flight"
    values: Values = {"impacting_mm": top, "flight_mm": bottom}
    if both.unstable is None:
        text += "; the third is looked for only in models that have a closed form"
        rule = "two motions, each the steady end of one direction"
    else:
        middle = 1e3 * both.unstable.u_max
        one, other = (float(abs(m)) for m in both.unstable.multipliers[:2])
        text += f", and the UNSTABLE {middle:.3f} mm (multipliers {one:.3f}, {other:.3f})"
        values |= {"unstable_mm": middle, "multiplier_1": one, "multiplier_2": other}
    yield Row("g4_coexisting", "G4, 3.4 Hz", said, text, AGREES, rule, values)


def shares(found: Study, hz: float) -> str:
    """The distribution of impacts right/left per cycle in words."""
    parts = [f"{r}/{l_} in {100 * share:.0f} %" for (r, l_), share in found.impacts[hz].shares[:4]]
    return ", ".join(parts) + " of the cycles"


def _secondary(found: Study) -> Iterator[Row]:
    first, second, third = SECONDARY_HZ
    for hz, key, usual, sometimes, said in (
        (first, "g4_053", (3, 3), 4, "3 impacts a side, sometimes 4"),
        (second, "g4_071", (2, 2), 3, "2 a side, sometimes a slight third"),
    ):
        seen = found.impacts[hz]
        more = seen.at_least(sometimes)
        yield Row(
            key, f"G4, {hz:g} Hz", said, f"impacts right/left {shares(found, hz)}",
            AGREES if seen.usual == usual and more > 0 else DEPARTS,
            f"most cycles {usual[0]}/{usual[1]}, some with {sometimes} or more on a side",
            {"usual_share": seen.share(usual), "sometimes_share": more},
        )  # fmt: skip
    seen = found.impacts[third]
    gap = findings.twice_a_side_mm(found.cases["G4"], third)
    yield Row(
        "g4_11", f"G4, {third:g} Hz", "2 a side, the second weak",
        f"impacts right/left {shares(found, third)}; "
        + (f"2/2 only up to G = {gap:.2f} mm" if gap > 0 else "2/2 at no gap up to 4 mm"),
        AGREES if seen.usual == (2, 2) else DEPARTS, "most cycles 2/2",
        {"one_one_share": seen.share((1, 1)), "two_two_share": seen.share((2, 2)),
         "two_two_gap_mm": gap},
    )  # fmt: skip


def _irregular(found: Study) -> Iterator[Row]:
    seen = found.impacts[IRREGULAR_HZ]
    share = seen.share((1, 2), (2, 1))
    sides = "right" if seen.share((2, 1)) > seen.share((1, 2)) else "left"
    yield Row(
        "g4_14", f"G4, {IRREGULAR_HZ:g} Hz", "left twice, right once",
        f"one side twice, the other once in {100 * share:.0f} % of the cycles"
        + (f" (from rest: {sides} twice); by symmetry the mirror attractor coexists, history "
           "picks the side" if share > 0.5 else f", {shares(found, IRREGULAR_HZ)}"),
        AGREES if share > 0.5 else DEPARTS, "2 on one side and 1 on the other in most cycles",
        {"twice_once_share": share},
    )  # fmt: skip


def _chaos(found: Study) -> Iterator[Row]:
    bands = findings.bands(CHAOS_HZ, found.exponents)
    exponents = [findings.exponent(found.cases["G4"], hz) for hz in (*SECONDARY_HZ, IRREGULAR_HZ)]
    where = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in bands)
    text = f"chaotic at {where} Hz" if bands else "nowhere chaotic"
    yield Row(
        "g4_chaos", "G4 below 1.5 Hz",
        "counts change from cycle to cycle; \"slightly quasi-periodic\", irregular 1 to 1.5 Hz",
        f"{text}; largest Lyapunov exponents "
        + ", ".join(f"{one:+.2f}" for one in exponents)
        + " per cycle at 0.53, 0.71, 1.1, 1.4 Hz",
        IN_KIND if min(exponents) > 0 else DEPARTS,
        "not periodic at these frequencies; the model's motion is chaotic, which is more than "
        "quasi-periodic",
        {"bands_hz": bands, "exponents": exponents},
    )  # fmt: skip
