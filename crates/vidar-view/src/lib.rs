//! Plots, pictures of depth and map, and the self-contained HTML report.
