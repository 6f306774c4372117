//! Depth Anything 3: views in, a prediction of depth, confidence and poses out.
