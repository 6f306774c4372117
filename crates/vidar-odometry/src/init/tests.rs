//! Tests of the start.
