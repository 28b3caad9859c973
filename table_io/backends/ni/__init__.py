"""An NI-DAQmx device."""
