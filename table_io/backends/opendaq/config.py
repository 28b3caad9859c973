"""Wiring of an openDAQ device."""

from pydantic import Field, field_validator

from table_io.config.base import list_duplicates
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError

NATIVE_SCHEME = "daq.nd://"


class OpenDaqWiring(BackendConfig):
    """Address of the device, and its signal for each channel."""

    device: str = Field(description="Native streaming: daq.nd://HOST or daq.nd://HOST:PORT.")
    signals: dict[str, str] = Field(
        min_length=1, description="Channel = id of the signal, or a unique end of it."
    )

    @field_validator("device")
    @classmethod
    def _check_device(cls, device: str) -> str:
        host, colon, port = device.removeprefix(NATIVE_SCHEME).partition(":")
        if not device.startswith(NATIVE_SCHEME) or not host or (colon and not port.isdecimal()):
            raise InputError(
                f"device {device!r} is not an openDAQ native connection",
                allowed="daq.nd://HOST or daq.nd://HOST:PORT",
            )
        return device

    @field_validator("signals")
    @classmethod
    def _check_signals(cls, signals: dict[str, str]) -> dict[str, str]:
        duplicates = list_duplicates([*signals.values()])
        if duplicates:
            raise InputError(
                f"signals wire {', '.join(duplicates)} to two channels",
                remedy="give each channel its own",
            )
        return signals

    def list_faults(self, rig: RigConfig) -> list[str]:
        """List signals of channels that the rig does not know."""
        unknown = [name for name in self.signals if name not in rig.channel_by_name]
        if not unknown:
            return []
        known = ", ".join(rig.channel_by_name)
        return [f"signals name unknown channels {', '.join(unknown)}; known: {known}"]

    def find_address(self, rig: RigConfig) -> str:
        return self.device

    @property
    def address(self) -> tuple[str, int]:
        """(host, port) of the streaming server."""
        host, _, port = self.device.removeprefix(NATIVE_SCHEME).partition(":")
        return host, int(port or 7420)
