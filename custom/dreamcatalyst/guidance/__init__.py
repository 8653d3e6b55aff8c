"""Rules of score distillation as a table, timesteps, and the guidance that applies them."""
