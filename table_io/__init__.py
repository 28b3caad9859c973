"""The rig: drives the table and acquires the sensors. Never imports `twin`."""
