//! Trajectories, PLY, GLB, COLMAP, transforms.json and depth PNG, written and read back.
