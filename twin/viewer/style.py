"""Colors, names and line widths of the view."""

Rgb = tuple[int, int, int]
# Lines contrast at least 3 : 1 with white and with BACKGROUND_COLOUR: time series have the theme of
# the viewer, light or dark, as background, drawn plots and the rig BACKGROUND_COLOUR.
BACKGROUND_COLOUR = (14, 16, 20)
RED, BLUE, TEAL = (240, 80, 75), (45, 130, 235), (0, 150, 136)
GREY, DARK_GREY, WHITE = (125, 131, 143), (58, 62, 70), (245, 245, 245)
STEEL_COLOUR, MASS_COLOUR, RUBBER_COLOUR, CONTACT_COLOUR = (
    (104, 110, 122),
    (66, 126, 148),
    (40, 42, 48),
    (205, 120, 0),
)
IDLE_COLOUR = (146, 150, 160)
GREEN, VIOLET, PLUM = (60, 150, 60), (165, 100, 225), (104, 76, 130)

# Legend name, color and width of every line, in the order of the columns of an entity. Lines with
# the same name share one legend entry.
LineStyle = tuple[str, Rgb, float]
RESTARTED_LABEL, FREE_LABEL = "twin, restarted", "twin, free-running"
LINE_STYLES: dict[str, tuple[LineStyle, ...]] = {
    "u/measured": (("measured", RED, 3.5),),
    "u/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "a/measured": (("measured", RED, 3.5), ("table, measured", BLUE, 1.5)),
    "a/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "force/measured": (("right, measured", RED, 3.5), ("left, measured", BLUE, 3.5)),
    "force/twin": ((RESTARTED_LABEL, TEAL, 1.5), (RESTARTED_LABEL, TEAL, 1.5)),
    "damper/measured": (("measured", RED, 3.5),),
    "damper/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "error": ((f"u, {FREE_LABEL}", GREY, 2.0), (f"u, {RESTARTED_LABEL}", TEAL, 2.0)),
    "impacts": (
        ("right, measured", RED, 3.5),
        ("left, measured", BLUE, 3.5),
        ("right, twin free", TEAL, 1.5),
        ("left, twin free", GREY, 1.2),
    ),
    "disagreement/band": (("band", CONTACT_COLOUR, 1.5),),
}
PRC_COLOURS = {"measured": (RED, BLUE), "twin": (TEAL, GREY)}
# Line of each compared channel; "": not drawn, because x differs in the same way as u.
CHANNEL_LINES = {
    "rel_disp_m": "u",
    "mass_disp_m": "",
    "mass_acc_m_s2": "a",
    "force_r1_n": "F right",
    "force_r2_n": "F right",
    "force_l1_n": "F left",
    "force_l2_n": "F left",
}
LINE_COLOURS = {
    "u": RED,
    "a": GREEN,
    "F right": VIOLET,
    "F left": BLUE,
    "stiffness": RED,
    "damping": BLUE,
    "gap_r": RED,
    "gap_l": BLUE,
}


def disagreement_style(name: str) -> tuple[LineStyle, ...]:
    """Return the line style of a disagreement ratio."""
    return ((name, LINE_COLOURS.get(name, GREY), 2.0),)


def drift_styles(parameter: str) -> tuple[LineStyle, ...]:
    """Return the line styles of a parameter drift and of the bounds of its interval."""
    colour = LINE_COLOURS.get(parameter, GREY)
    name = {"gap_r": "gap, right", "gap_l": "gap, left"}.get(parameter, parameter)
    return (name, colour, 2.5), ("± 2 sd", colour, 0.7), ("± 2 sd", colour, 0.7)
