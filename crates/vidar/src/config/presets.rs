//! Presets: small files over the defaults, embedded in the program.

/// A named set of values.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Name on the command line.
    pub name: &'static str,
    /// When to use it.
    pub about: &'static str,
    /// The values.
    pub toml: &'static str,
}

/// Every preset.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "euroc",
        about: "drone in a room or hall, wide-angle grey camera, 20 Hz (EuRoC MAV)",
        toml: include_str!("../../presets/euroc.toml"),
    },
    Preset {
        name: "tum-rgbd",
        about: "hand-held camera at a desk or in an office, 30 Hz (TUM RGB-D, 7-Scenes)",
        toml: include_str!("../../presets/tum_rgbd.toml"),
    },
    Preset {
        name: "fast",
        about: "fast preview: half the resolution, coarser voxels",
        toml: include_str!("../../presets/fast.toml"),
    },
    Preset {
        name: "quality",
        about: "slower, better surface: closer keyframes, larger images",
        toml: include_str!("../../presets/quality.toml"),
    },
    Preset {
        name: "live",
        about: "of `vidar live` unless another is given: small images, a surface after every few keyframes",
        toml: include_str!("../../presets/live.toml"),
    },
    Preset {
        name: "demo",
        about: "the synthetic room of `vidar demo`: small images, a few metres",
        toml: include_str!("../../presets/demo.toml"),
    },
];
