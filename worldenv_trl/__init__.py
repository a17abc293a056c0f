"""Post-train vision-language-action policies by reinforcement learning inside a learned world model."""

__version__ = "0.1.0"
