"""openDAQ devices that answer to discovery on this network, and their signals."""

from typing import Any

from table_io.backends.device import Device, Ports
from table_io.backends.opendaq.source import library

NETWORK = ("daq.nd://", "daq.opcua://")
REFERENCE = "daqref://"  # the library's own simulated devices


def found(addresses: tuple[str, ...] = ()) -> tuple[Device, ...]:
    """Every device that is discovered, and those at `addresses` that answer; BadInput without the
    library. The signals are those that its native streaming shows."""
    daq = library()
    builder = daq.InstanceBuilder()
    builder.global_log_level = daq.LogLevel.Off
    instance = builder.build()
    devices = []
    for info in instance.available_devices:
        address = str(info.connection_string)
        if not address.startswith((*NETWORK, REFERENCE)):
            continue  # what is no data acquisition: a sound card
        product = " ".join(filter(None, (str(info.manufacturer), str(info.model))))
        simulated = address.startswith(REFERENCE)
        serial, ports = str(info.serial_number), _inputs(instance, address)
        devices.append(Device("opendaq", address, "discovery", product, serial, simulated, ports))
    for address in addresses:
        if address not in {one.name for one in devices} and (ports := _inputs(instance, address)):
            devices.append(Device("opendaq", address, "machine card", ports=ports))
    return tuple(devices)


def _inputs(instance: Any, address: str) -> tuple[Ports, ...]:
    """The signals of a device that have time stamps; none where it cannot be looked into."""
    try:
        device = instance.add_device(address)
    except RuntimeError:
        return ()
    try:
        signals = [one for one in device.signals_recursive if one.domain_signal is not None]
        names = tuple(str(one.global_id) for one in signals)
        ranges = {pair for one in signals if (pair := _volts(one.descriptor)) is not None}
        return (Ports("AI", names, tuple(sorted(ranges))),) if names else ()
    except RuntimeError:
        return ()
    finally:
        instance.remove_device(device)


def _volts(descriptor: Any) -> tuple[float, float] | None:
    """(low, high) of a signal in V; None where it is in another unit, or does not say."""
    if descriptor is None or descriptor.unit is None or descriptor.value_range is None:
        return None
    if str(descriptor.unit.symbol) != "V":
        return None
    return float(descriptor.value_range.low_value), float(descriptor.value_range.high_value)
