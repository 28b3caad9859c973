"""An openDAQ device."""
