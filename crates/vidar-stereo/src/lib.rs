//! Multi-view stereo from known poses: a geometry model that needs no weights.
