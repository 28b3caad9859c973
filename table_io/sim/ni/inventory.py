"""Inventory of the simulated device: names, ranges and rates for discovery."""

from table_io.backends.ni.config import NiWiring

# DAQmx attribute numbers.
DEVICE_NAMES, PRODUCT_TYPE, SERIAL_NUMBER, IS_SIMULATED = 0x193B, 0x0631, 0x0632, 0x22CA
AI_CHANNELS, AO_CHANNELS, DI_LINES, DO_LINES = 0x231E, 0x231F, 0x2320, 0x2321
AI_RANGES, AO_RANGES, AI_MAX_RATE, AO_MAX_RATE = 0x2990, 0x299B, 0x298C, 0x2997


def list_names(wiring: NiWiring, device: str, attribute: int) -> str | None:
    """Return the value of a text attribute, names separated by commas; None if unknown."""
    inputs = [analog_input.physical for analog_input in wiring.inputs]
    values = {
        AI_CHANNELS: inputs,
        AO_CHANNELS: [wiring.output],
        DI_LINES: [wiring.heartbeat, *wiring.digital_inputs.values()],
        DO_LINES: [wiring.heartbeat],
    }
    if attribute == DEVICE_NAMES:
        terminals = [*inputs, wiring.output, wiring.heartbeat]
        return ", ".join(dict.fromkeys(terminal.split("/")[0] for terminal in terminals))
    if attribute == PRODUCT_TYPE:
        return "Simulated table"
    if attribute not in values:
        return None
    return ", ".join(terminal for terminal in values[attribute] if terminal.split("/")[0] == device)


def list_numbers(attribute: int, max_rate_hz: float) -> tuple[float, ...]:
    """Return a numeric attribute: ranges (low, high, ...) in V, rates in Hz; empty if unknown."""
    values = {
        SERIAL_NUMBER: (0.0,),
        IS_SIMULATED: (1.0,),
        AI_RANGES: (-10.0, 10.0),
        AO_RANGES: (-10.0, 10.0),
        AI_MAX_RATE: (max_rate_hz,),
        AO_MAX_RATE: (max_rate_hz,),
    }
    return values.get(attribute, ())
