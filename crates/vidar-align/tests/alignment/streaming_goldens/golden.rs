//! The recordings, and how they are read.

use nalgebra::{Matrix3, Vector3};
use safetensors::{Dtype, SafeTensors};
use std::path::PathBuf;
use vidar_align::streaming::{PointMap, unproject};
use vidar_core::{LieGroup, Pinhole, Se3, Sim3, So3};

pub fn folder() -> Option<PathBuf> {
    vidar_core::testing::shared_data("golden/streaming")
}

pub struct Golden(Vec<u8>);

impl Golden {
    pub fn open(name: &str) -> Option<Self> {
        folder().map(|f| Self(std::fs::read(f.join(format!("{name}.safetensors"))).unwrap()))
    }

    pub fn has(&self, name: &str) -> bool {
        SafeTensors::deserialize(&self.0).unwrap().tensor(name).is_ok()
    }

    pub fn shape(&self, name: &str) -> Vec<usize> {
        SafeTensors::deserialize(&self.0).unwrap().tensor(name).unwrap().shape().to_vec()
    }

    /// Numbers of any type.
    pub fn get(&self, name: &str) -> Vec<f64> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
        let bytes = tensor.data();
        match tensor.dtype() {
            Dtype::F64 => bytes.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect(),
            Dtype::F32 => {
                bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()).into()).collect()
            }
            Dtype::I64 => {
                bytes.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f64).collect()
            }
            other => panic!("{name}: {other:?}"),
        }
    }

    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.get(name).iter().map(|v| *v as f32).collect()
    }

    pub fn points(&self, name: &str) -> Vec<Vector3<f64>> {
        self.get(name).chunks_exact(3).map(Vector3::from_column_slice).collect()
    }

    /// Similarities stored as `<stem>s`, `<stem>R`, `<stem>t`.
    pub fn similarities(&self, stem: &str) -> Vec<Sim3> {
        let (s, r, t) =
            (self.get(&format!("{stem}s")), self.get(&format!("{stem}R")), self.get(&format!("{stem}t")));
        s.iter()
            .zip(r.chunks_exact(9))
            .zip(t.chunks_exact(3))
            .map(|((s, r), t)| {
                let rotation = So3::from_matrix(&Matrix3::from_row_slice(r)).unwrap();
                Sim3::new(rotation, Vector3::from_column_slice(t), *s).unwrap()
            })
            .collect()
    }
}

/// Largest difference of scale, rotation matrix and translation.
pub fn apart(a: &Sim3, b: &Sim3) -> f64 {
    let rotation = (a.rotation.matrix() - b.rotation.matrix()).amax();
    (a.scale - b.scale).abs().max(rotation).max((a.translation - b.translation).amax())
}

pub fn all_within(found: &[Sim3], expected: &[Sim3], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (k, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!(apart(a, b) <= tolerance, "{what} {k}: {:e}", apart(a, b));
    }
}

pub fn point_map(golden: &Golden, which: &str) -> PointMap {
    let shape = golden.shape(&format!("conf{which}"));
    PointMap {
        points: golden.points(&format!("point_map{which}")),
        confidence: golden.f32(&format!("conf{which}")),
        frame_len: shape[1] * shape[2],
    }
}

pub fn cameras(golden: &Golden, stem: &str, width: usize, height: usize) -> Vec<(Pinhole, Se3)> {
    let prefix = if stem.is_empty() { String::new() } else { format!("{stem}.") };
    let key = if stem.is_empty() { "extrinsics_w2c".into() } else { format!("{prefix}extrinsics") };
    let intrinsics = golden.get(&format!("{prefix}intrinsics"));
    let rows = golden.get(&key);
    intrinsics
        .chunks_exact(9)
        .zip(rows.chunks_exact(12))
        .map(|(k, e)| {
            let camera = Pinhole { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width, height };
            let rotation = Matrix3::new(e[0], e[1], e[2], e[4], e[5], e[6], e[8], e[9], e[10]);
            let camera_from_chunk = Se3 {
                rotation: So3::from_matrix(&rotation).unwrap(),
                translation: Vector3::new(e[3], e[7], e[11]),
            };
            (camera, camera_from_chunk.inverse())
        })
        .collect()
}

/// Points of `frames` of a chunk of the end-to-end recording.
pub fn chunk_points(golden: &Golden, stem: &str, frames: std::ops::Range<usize>) -> PointMap {
    let shape = golden.shape(&format!("{stem}.depth"));
    let (height, width) = (shape[1], shape[2]);
    let n = width * height;
    let (depth, confidence) = (golden.f32(&format!("{stem}.depth")), golden.f32(&format!("{stem}.conf")));
    let poses = cameras(golden, stem, width, height);
    PointMap {
        points: frames
            .clone()
            .flat_map(|f| unproject(&depth[f * n..(f + 1) * n], &poses[f].0, &poses[f].1))
            .collect(),
        confidence: confidence[frames.start * n..frames.end * n].to_vec(),
        frame_len: n,
    }
}

/// A chunk of the end-to-end recording as a prediction.
pub fn recorded_chunk(golden: &Golden, k: usize, first_frame: usize) -> vidar_core::GeometryPrediction {
    let stem = format!("chunk{k}");
    let (width, height) = (28, 14);
    let n = width * height;
    let (depth, confidence) = (golden.f32(&format!("{stem}.depth")), golden.f32(&format!("{stem}.conf")));
    let image = |values: &[f32]| vidar_core::Image::from_vec(width, height, values.to_vec()).unwrap();
    let views =
        cameras(golden, &stem, width, height).into_iter().enumerate().map(|(f, (intrinsics, pose))| {
            // The network's confidence less 1, 0 or more, as the probability that the geometry model makes of it.
            let odds = &confidence[f * n..(f + 1) * n];
            let probability: Vec<f32> = odds.iter().map(|c| c / (1.0 + c)).collect();
            vidar_core::ViewGeometry {
                frame_id: vidar_core::FrameId((first_frame + f) as u32),
                chunk_from_camera: pose,
                intrinsics,
                depth: vidar_core::RelativeDepth::new(image(&depth[f * n..(f + 1) * n])),
                confidence: vidar_core::Confidence::new(image(&probability)),
            }
        });
    vidar_core::GeometryPrediction {
        chunk_id: vidar_core::ChunkId(k as u32),
        frame: vidar_core::model::ChunkFrame::ModelNative,
        views: views.collect(),
    }
}
