"""The paper's experiments (section 5) and ours; each prints its figures."""
