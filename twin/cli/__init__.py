"""The command line: `entry` sends orders and starts it, `table` lists every command."""
