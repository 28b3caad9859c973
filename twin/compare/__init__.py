"""Comparison of model and rig: twins, cycles, PRC points, monitoring.

The predicted stream carries two twins with the same channels: `free/...` runs from the start of
the run on the measured table acceleration; `window/...` restarts from the measured state in every
window.
"""

TWIN_NAMES = ("free", "window")
PREDICTED_CHANNELS = (
    "rel_disp_m", "rel_vel_m_s", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
TWIN_CHANNELS = tuple(f"{track}/{name}" for track in TWIN_NAMES for name in PREDICTED_CHANNELS)
COMPARED_CHANNELS = (
    "rel_disp_m", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
