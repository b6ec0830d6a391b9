"""Building a layer: what is to be done, the plan, the run, publishing, and clearing what builds have left."""
