//! Readers of EuRoC, TUM RGB-D, 7-Scenes and image folders into one time-ordered stream.
