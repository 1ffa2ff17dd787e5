"""The subject of a capture that has neither clean plates nor masks: what all cameras look at, found from the
photographs. ``decide`` composes: volume, colours, occupancy, and a plate guessed from the surroundings."""
