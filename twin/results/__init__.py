"""What a run showed, worked out once; every page, console line and file shows these values."""
