"""What the simulated device says of itself when it is asked what there is."""

from table_io.wiring.ni import NiWiring

DEVICES, PRODUCT, SERIAL, SIMULATED = 0x193B, 0x0631, 0x0632, 0x22CA  # as DAQmx numbers them
INPUTS, OUTPUTS, LINES_IN, LINES_OUT = 0x231E, 0x231F, 0x2320, 0x2321
INPUT_RANGES, OUTPUT_RANGES, INPUT_RATE, OUTPUT_RATE = 0x2990, 0x299B, 0x298C, 0x2997


def names(wiring: NiWiring, device: str, attribute: int) -> str | None:
    """The names that a text of the device lists; None where there is no such text."""
    inputs = [one.physical for one in wiring.inputs]
    told = {
        INPUTS: inputs,
        OUTPUTS: [wiring.output],
        LINES_IN: [wiring.heartbeat, *wiring.watched.values()],
        LINES_OUT: [wiring.heartbeat],
    }
    if attribute == DEVICES:
        all_of_them = [*inputs, wiring.output, wiring.heartbeat]
        return ", ".join(dict.fromkeys(one.split("/")[0] for one in all_of_them))
    if attribute == PRODUCT:
        return "Simulated table"
    if attribute not in told:
        return None
    return ", ".join(one for one in told[attribute] if one.split("/")[0] == device)


def numbers(attribute: int, most_hz: float) -> tuple[float, ...]:
    """Ranges in V, (low, high, ...), rates in Hz, the serial number; empty: there is no such."""
    told = {
        SERIAL: (0.0,),
        SIMULATED: (1.0,),
        INPUT_RANGES: (-10.0, 10.0),
        OUTPUT_RANGES: (-10.0, 10.0),
        INPUT_RATE: (most_hz,),
        OUTPUT_RATE: (most_hz,),
    }
    return told.get(attribute, ())
