//! Confidence-weighted TSDF and point fusion, mesh extraction, coverage.
