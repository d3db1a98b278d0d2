"""What a user does with recordings: replay, judge, report, tune, simulate, demonstrate."""
