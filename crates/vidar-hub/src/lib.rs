//! Checkpoints: the list of official ones, and finding, fetching, resuming and verifying them.
