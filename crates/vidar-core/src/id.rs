//! Identifiers, one type each, so that the compiler rejects a frame's number where a keyframe's is expected.

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
    /// A keyframe: a frame selected for optimisation and dense reconstruction.
    KeyframeId
);
id_type!(
    /// A group of keyframes that a geometry model processes together.
    ChunkId
);
id_type!(
    /// A sparse 3-D point estimated by the odometry.
    LandmarkId
);
id_type!(
    /// A camera of the rig (`cam0`, `cam1`, …).
    CameraId
);
