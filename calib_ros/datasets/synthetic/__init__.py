"""The ray-cast street behind datasets/synthetic.py: what stands in it, how rays meet it, how the two sensors see it."""
