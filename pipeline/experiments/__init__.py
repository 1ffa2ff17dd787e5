"""The paper's experiments (section 5) and ours: each a function from a model and a renderer to figures and rows."""
