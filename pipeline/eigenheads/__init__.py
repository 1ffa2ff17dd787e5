"""Head models (section 3): the mean head, its modes, landmarks and levels of detail."""
