"""Training trigger policies by reinforcement, with Stable-Baselines3 on stored traces."""
