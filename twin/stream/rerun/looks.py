"""Colours, names and widths of what the view draws."""

Rgb = tuple[int, int, int]
RED, BLUE = (255, 92, 87), (84, 160, 255)
WHITE, GREY, DIM = (245, 245, 245), (150, 156, 168), (58, 62, 70)
STEEL, MASS, RUBBER, CONTACT = (104, 110, 122), (66, 126, 148), (40, 42, 48), (255, 176, 46)
IDLE, PALE = (146, 150, 160), (200, 206, 216)
GREEN, VIOLET, PLUM = (120, 200, 110), (190, 130, 240), (104, 76, 130)

# Legend name, colour and width of every line, in the order of the columns of an entity. Lines of
# one name have one place in the legend.
Line = tuple[str, Rgb, float]
RESTARTED, FREE = "twin, restarted", "twin, free-running"
LINES: dict[str, tuple[Line, ...]] = {
    "u/measured": (("measured", RED, 3.5),),
    "u/twin": ((FREE, GREY, 1.5), (RESTARTED, WHITE, 1.3)),
    "a/measured": (("measured", RED, 3.5), ("table, measured", BLUE, 1.5)),
    "a/twin": ((FREE, GREY, 1.5), (RESTARTED, WHITE, 1.3)),
    "force/measured": (("right, measured", RED, 3.5), ("left, measured", BLUE, 3.5)),
    "force/twin": ((RESTARTED, WHITE, 1.5), (RESTARTED, WHITE, 1.5)),
    "damper/measured": (("measured", RED, 3.5),),
    "damper/twin": ((FREE, GREY, 1.5), (RESTARTED, WHITE, 1.3)),
    "error": ((f"u, {FREE}", GREY, 2.0), (f"u, {RESTARTED}", WHITE, 2.0)),
    "impacts": (
        ("right, measured", RED, 3.5),
        ("left, measured", BLUE, 3.5),
        ("right, twin free", WHITE, 1.5),
        ("left, twin free", GREY, 1.2),
    ),
    "disagreement/band": (("band", CONTACT, 1.5),),
}
PRC_COLOURS = {"measured": (RED, BLUE), "twin": (WHITE, PALE)}
# The line of a compared channel; x is left out, it differs as u does.
LINE_OF = {
    "rel_disp_m": "u",
    "mass_disp_m": "",
    "mass_acc_m_s2": "a",
    "force_r1_n": "F right",
    "force_r2_n": "F right",
    "force_l1_n": "F left",
    "force_l2_n": "F left",
}
PAINT = {
    "u": RED,
    "a": GREEN,
    "F right": VIOLET,
    "F left": BLUE,
    "stiffness": RED,
    "damping": BLUE,
    "gap_r": RED,
    "gap_l": BLUE,
}


def share_line(name: str) -> tuple[Line, ...]:
    """Looks of a disagreement."""
    return ((name, PAINT.get(name, GREY), 2.0),)


def drift_lines(parameter: str) -> tuple[Line, ...]:
    """Looks of a parameter's change and of the ends of its interval."""
    colour = PAINT.get(parameter, GREY)
    name = {"gap_r": "gap, right", "gap_l": "gap, left"}.get(parameter, parameter)
    return (name, colour, 2.5), ("± 2 sd", colour, 0.7), ("± 2 sd", colour, 0.7)
