"""Section `[machine]` of a rig file."""

from pydantic import Field

from table_io.config.backend import BackendConfig
from table_io.config.rig import RigConfig


class MachineConfig(BackendConfig):
    """Machine in a separate process: `shaketwin table` simulates its [simulated] table."""

    endpoint: str = Field(description="tcp/127.0.0.1:PORT or unix/PATH, on this computer only.")

    def find_address(self, rig: RigConfig) -> str:
        return self.endpoint
