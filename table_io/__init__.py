"""The rig: drives the shaking table and acquires the sensors. It never imports `twin`."""
