//! The corridor: configuration, events, run folder, and the stages wired together.
