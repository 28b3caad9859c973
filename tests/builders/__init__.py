"""What tests of all folders build their cases from.

`profiles`: `make_profile(gap_mm, tables, start_hz=..., ...)` returns a stepped sine with other
    keys and tables; `make_history_profile(kind, ...)` one of any other kind; `SPECIMEN`;
    `read_shipped_profile(name, table={...})` a shipped one; `list_shipped_sweeps()`.
`rigs`: `RIG`, the simulated rig as shipped, with `RIG_TEXT`, `NOISE_SI` and `CHANNEL_ROWS`;
    `read_rig_text(name)` and `read_rig(name)` of any shipped one; `change_rig(...)` with other
    sensors and tables; `make_faulty_rig(faults, ...)` with planted faults and other noise;
    `make_lab_rig(...)` with more channels than the canonical ones.
`truths`: `seal_truth(folder, text)` writes a hidden truth and returns its keys of [simulated].
`sessions`: `make_start(...)`, the first record of any run; `play_session(...)` plays a whole
    session unpaced, `play_guarded(...)` a drive under protection alone.
`drives`: `sine_segments(drive)`, `sine_segment_at(drive, index)`; commands `make_bump(...)`,
    `make_rise(...)`.
`recordings`: fixtures of the session: `bundle` and its `log_file`, `recording` (six steps across
    the down-jump of G4 and back, recorded once).
`ports`: `free_port()` and `free_endpoint()` of the loopback interface.
`input_errors.raises_input_error` (next to this package) requires a refusal by its fields.
"""
