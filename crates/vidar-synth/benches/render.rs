//! Rays per second of the renderer.

fn main() {
    divan::main();
}
