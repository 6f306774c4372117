//! Identifiers that cannot be mixed up: a frame is not a keyframe, a chunk is not a camera.

macro_rules! id_type {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(
            Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// The identifier as an index into a dense array.
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{}", self.0)
            }
        }
    };
}

id_type!(
    /// A captured image, counted in the order of time within one sequence.
    FrameId
);
id_type!(
    /// A frame that was chosen to carry geometry.
    KeyframeId
);
id_type!(
    /// A group of keyframes that a geometry model sees together.
    ChunkId
);
id_type!(
    /// A sparse 3-D point of the odometry.
    LandmarkId
);
id_type!(
    /// A camera of the rig (`cam0`, `cam1`, …).
    CameraId
);
