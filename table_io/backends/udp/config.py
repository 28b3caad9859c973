"""Wiring of a real-time target that speaks our UDP packets."""

from pydantic import Field, field_validator

from table_io.config.backend import BackendConfig
from table_io.config.base import Positive
from table_io.config.rig import RigConfig
from table_io.errors import InputError


class UdpWiring(BackendConfig):
    """Address and timing of the target; the wiring of its converters is configured there."""

    target: str = Field(description="HOST:PORT of the target.")
    rig_port: int = Field(0, ge=0, le=65535, strict=True, description="Port of the rig; 0: any.")
    replace_after_ms: Positive = Field(
        40.0, le=1000.0, description="From a decision to the first sample it can change."
    )

    @field_validator("target")
    @classmethod
    def _check_target(cls, target: str) -> str:
        host, _, port = target.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
            raise InputError(
                f"{target!r} is not an address",
                remedy="give HOST:PORT with a port of 1 to 65535, e.g. 192.168.7.5:7460",
            )
        return target

    def find_address(self, rig: RigConfig) -> str:
        return self.target

    @property
    def address(self) -> tuple[str, int]:
        """(host, port) of the target."""
        host, _, port = self.target.rpartition(":")
        return host, int(port)
