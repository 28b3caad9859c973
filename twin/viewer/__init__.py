"""Live and recorded runs in the Rerun viewer: blocks and records with a fixed layout."""
