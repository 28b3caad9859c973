"""The blind study of discovery: cases with a sealed truth, verdicts on them, and the score.

`cells` draws a case from its number, `sizing` scales its effect to the residual it shall leave,
`making` plays and records it, `asking` has it judged, `scoring` opens the truth, `rates` and
`pages` count. `command` runs it all on a few processes (`crew`) and goes on where it stopped.
"""
