"""What recordings hold, of a run or of a folder of any kind: curves, report, index, comparison."""
