"""Discovery of openDAQ devices on this network, and of their signals."""

from typing import Any

from table_io.backends.discovery import ChannelGroup, DiscoveredDevice
from table_io.backends.opendaq.source import load_library

NETWORK_SCHEMES = ("daq.nd://", "daq.opcua://")
SIMULATED_SCHEME = "daqref://"  # the library's own simulated devices


def discover_devices(addresses: tuple[str, ...] = ()) -> tuple[DiscoveredDevice, ...]:
    """Return the discovered devices and those at `addresses` that answer.

    The channels are the signals of native streaming. InputError if the library is not installed.
    """
    daq = load_library()
    builder = daq.InstanceBuilder()
    builder.global_log_level = daq.LogLevel.Off
    instance = builder.build()
    devices = []
    for info in instance.available_devices:
        address = str(info.connection_string)
        if not address.startswith((*NETWORK_SCHEMES, SIMULATED_SCHEME)):
            continue  # not a data acquisition device, but a sound card for example
        product = " ".join(filter(None, (str(info.manufacturer), str(info.model))))
        simulated = address.startswith(SIMULATED_SCHEME)
        serial, ports = str(info.serial_number), _input_ports(instance, address)
        devices.append(
            DiscoveredDevice("opendaq", address, "discovery", product, serial, simulated, ports)
        )
    for address in addresses:
        if address not in {device.name for device in devices} and (
            ports := _input_ports(instance, address)
        ):
            devices.append(DiscoveredDevice("opendaq", address, "rig file", ports=ports))
    return tuple(devices)


def _input_ports(instance: Any, address: str) -> tuple[ChannelGroup, ...]:
    """Return the signals of a device that have time stamps; empty if it cannot be opened."""
    try:
        device = instance.add_device(address)
    except RuntimeError:
        return ()
    try:
        signals = [
            signal for signal in device.signals_recursive if signal.domain_signal is not None
        ]
        names = tuple(str(signal.global_id) for signal in signals)
        ranges = {
            pair for signal in signals if (pair := _voltage_range(signal.descriptor)) is not None
        }
        return (ChannelGroup("AI", names, tuple(sorted(ranges))),) if names else ()
    except RuntimeError:
        return ()
    finally:
        instance.remove_device(device)


def _voltage_range(descriptor: Any) -> tuple[float, float] | None:
    """Return (low, high) of a signal in V; None if unknown or in another unit."""
    if descriptor is None or descriptor.unit is None or descriptor.value_range is None:
        return None
    if str(descriptor.unit.symbol) != "V":
        return None
    return float(descriptor.value_range.low_value), float(descriptor.value_range.high_value)
