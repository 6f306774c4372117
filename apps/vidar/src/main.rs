//! The `vidar` program.

fn main() {}
