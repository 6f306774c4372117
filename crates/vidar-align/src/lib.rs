//! Placement of predicted chunks in the metric world.
