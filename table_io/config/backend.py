"""Path from which plug-ins import the base class of their section of a rig file."""

from table_io.config.rig import BackendConfig

__all__ = ["BackendConfig"]
