"""Control laws: functions of an observation that return a steering action, and the speed law."""
