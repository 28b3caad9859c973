"""Where model and rig differ: windows, cycles, PRC points.

The predicted stream carries two twins, each with the same channels: `free/...` runs on from the
start of the run on the measured table acceleration; `window/...` restarts from the measured state
every window.
"""

TRACKS = ("free", "window")
PREDICTED_CHANNELS = (
    "rel_disp_m", "rel_vel_m_s", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
PREDICTED = tuple(f"{track}/{name}" for track in TRACKS for name in PREDICTED_CHANNELS)
COMPARED = (
    "rel_disp_m", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
