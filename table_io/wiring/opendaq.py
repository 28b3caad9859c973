"""An openDAQ device."""

from pydantic import Field, field_validator

from table_io.card import Card
from table_io.channels import BY_NAME

NATIVE = "daq.nd://"


class OpenDaqWiring(Card):
    """Which signal of which device is which channel."""

    device: str = Field(description="daq.nd://HOST or daq.nd://HOST:PORT, native streaming.")
    signals: dict[str, str] = Field(
        min_length=1, description="Channel = the signal's id, or as much of its end as is unique."
    )

    @field_validator("device")
    @classmethod
    def _native(cls, device: str) -> str:
        host, colon, port = device.removeprefix(NATIVE).partition(":")
        if not device.startswith(NATIVE) or not host or (colon and not port.isdecimal()):
            raise ValueError(
                f"device {device!r} is no openDAQ native connection; allowed: daq.nd://HOST or "
                "daq.nd://HOST:PORT"
            )
        return device

    @field_validator("signals")
    @classmethod
    def _known(cls, signals: dict[str, str]) -> dict[str, str]:
        unknown = [name for name in signals if name not in BY_NAME]
        if unknown:
            raise ValueError(
                f"signals name {', '.join(unknown)}, no channel; known: {', '.join(BY_NAME)}"
            )
        ids = list(signals.values())
        twice = sorted({one for one in ids if ids.count(one) > 1})
        if twice:
            raise ValueError(f"signals wire {', '.join(twice)} to two channels; one signal each")
        return signals

    @property
    def address(self) -> tuple[str, int]:
        """(host, port) of its streaming server."""
        host, _, port = self.device.removeprefix(NATIVE).partition(":")
        return host, int(port or 7420)
