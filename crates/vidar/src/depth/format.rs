//! Output formats of `vidar depth`.

use crate::error::Error;

/// A format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthFormat {
    /// 16-bit PNG of each view.
    DepthPng,
    /// Confident pixels of all views as one cloud.
    Ply,
    /// Image and coloured depth, JPEG.
    DepthVis,
    /// The official program's compact npz.
    MiniNpz,
    /// The official program's npz with images.
    Npz,
    /// The official program's scene.
    Glb,
    /// The official program's COLMAP model.
    Colmap,
}

/// Names on the command line; the official ones are the official program's.
const FORMATS: &[(&str, DepthFormat)] = &[
    ("depth_png", DepthFormat::DepthPng),
    ("ply", DepthFormat::Ply),
    ("depth_vis", DepthFormat::DepthVis),
    ("mini_npz", DepthFormat::MiniNpz),
    ("npz", DepthFormat::Npz),
    ("glb", DepthFormat::Glb),
    ("colmap", DepthFormat::Colmap),
];

impl DepthFormat {
    /// Name on the command line.
    pub fn name(self) -> &'static str {
        FORMATS.iter().find(|(_, f)| *f == self).map_or("", |(name, _)| name)
    }

    /// Whether it cannot be written without cameras.
    pub fn needs_cameras(self) -> bool {
        matches!(self, Self::Ply | Self::Glb | Self::Colmap)
    }
}

/// Formats from a list such as `depth_png,ply`, or `mini_npz-glb` as the official program joins them.
pub fn parse_formats(text: &str) -> Result<Vec<DepthFormat>, Error> {
    let mut formats = Vec::new();
    for name in text.split([',', '-', ' ']).filter(|n| !n.is_empty()) {
        let Some((_, format)) = FORMATS.iter().find(|(n, _)| *n == name) else {
            let known = FORMATS.iter().map(|(n, _)| *n).collect::<Vec<_>>().join(", ");
            let (what, hint) = (format!("--format {name:?} is unknown"), format!("formats are {known}"));
            return Err(Error::Usage { what, hint });
        };
        if !formats.contains(format) {
            formats.push(*format);
        }
    }
    Ok(formats)
}

/// At which size clouds and depth images are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resolution {
    /// Size of the network's output.
    Processed,
    /// Size of the images.
    Input,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_listed_in_either_way_and_once() {
        let parsed = parse_formats("mini_npz-glb-depth_vis").unwrap();
        assert_eq!(parsed, [DepthFormat::MiniNpz, DepthFormat::Glb, DepthFormat::DepthVis]);
        assert_eq!(parse_formats("ply, ply,npz").unwrap(), [DepthFormat::Ply, DepthFormat::Npz]);
        assert!(parse_formats("gs_ply").unwrap_err().hint().unwrap().contains("depth_png"));
        assert!(FORMATS.iter().all(|(name, f)| f.name() == *name));
    }
}
