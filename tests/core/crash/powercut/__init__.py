"""Checks that nothing wrong is read back after a power cut, in any legal state of the disk.

`disk` records what a run does to the disk and builds the states that a cut may leave; `histories`
draws the runs; `promises` says what must be there; `checker` opens each state and compares;
`planted` are bugs that the checker must find.
"""
