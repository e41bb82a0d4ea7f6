"""Speed, measured against what a user would pick instead: `slotfilm bench`.

Every file but the few that do the measuring (`rounds`, `results`, `contender`, `serving`) holds one subject of the
command line. Other people's software runs in child processes of an environment of its own, by the scripts in `peers`.
"""
