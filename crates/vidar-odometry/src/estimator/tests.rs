//! Smoother tests.
