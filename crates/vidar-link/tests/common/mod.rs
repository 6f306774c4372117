//! A model, chunks and comparisons that the tests share.
#![allow(dead_code)] // each test uses a part

use std::ops::Range;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, Confidence, FrameId, FrameImage, GeometryPrediction, Image, ModelInfo,
    Pinhole, RelativeDepth, Se3, So3, Timestamp, ViewGeometry, Watch,
};
use vidar_link::geometry::{ModelFacts, Predicted, Served};

pub const WIDTH: usize = 24;
pub const HEIGHT: usize = 16;

/// A model whose depth is the brightness of the image.
pub struct Brightness(pub ModelFacts);

pub fn facts(model: &str) -> ModelFacts {
    let info = ModelInfo {
        name: model.into(),
        licence: "MIT".into(),
        weights_sha256: Some("0123456789abcdef".repeat(4)),
        needs_poses: false,
        min_views: 1,
    };
    ModelFacts {
        model: model.into(),
        licence: "MIT".into(),
        info,
        token_channels: Some(3),
        arithmetic: "f32".into(),
    }
}

impl Served for Brightness {
    fn facts(&self, settings: &str) -> Result<ModelFacts, String> {
        match settings {
            "impossible" => Err("no such mode".into()),
            _ => Ok(self.0.clone()),
        }
    }

    fn predict(
        &self,
        _: &str,
        wants_tokens: bool,
        views: &ChunkViews,
        wanted: Range<usize>,
        _: Watch<'_>,
    ) -> Result<Predicted, String> {
        let view = |v: &ChunkView| {
            let gray = v.image.to_gray8();
            ViewGeometry {
                frame_id: v.frame_id,
                chunk_from_camera: v.world_from_camera.unwrap_or(Se3::IDENTITY),
                intrinsics: v.intrinsics,
                depth: RelativeDepth::new(gray.map(|g| f32::from(*g) / 7.0)),
                confidence: Confidence::new(gray.map(|g| f32::from(*g) / 255.0)),
            }
        };
        assert!(views.id.0 != 666, "a bug in the model");
        let views: Vec<ViewGeometry> = views.views[wanted].iter().map(view).collect();
        let tokens = views.iter().map(|v| vec![v.frame_id.0 as f32 + 0.1; 6]).collect();
        Ok(Predicted {
            geometry: GeometryPrediction { chunk_id: ChunkId(0), frame: ChunkFrame::ModelNative, views },
            tokens: if wants_tokens { tokens } else { Vec::new() },
        })
    }
}

pub fn chunk(id: u32) -> ChunkViews {
    let intrinsics = Pinhole::new(20.0, 21.0, 11.5, 7.5, WIDTH, HEIGHT).unwrap();
    let view = |i: u32| ChunkView {
        frame_id: FrameId(100 * id + i),
        time: Timestamp::from_nanos(i64::from(i)),
        image: match i % 3 {
            0 => FrameImage::Gray8(Image::from_fn(WIDTH, HEIGHT, |x, y| (9 * x + 5 * y + i as usize) as u8)),
            1 => FrameImage::Rgb8(Image::from_fn(WIDTH, HEIGHT, |x, y| [x as u8, y as u8, (id + i) as u8])),
            _ => FrameImage::Gray16(Image::from_fn(WIDTH, HEIGHT, |x, y| (1000 * x + y) as u16)),
        },
        intrinsics,
        world_from_camera: i.is_multiple_of(2).then(|| {
            let turn = So3::from_quaternion(0.1 * f64::from(i), 0.2, -0.3, 0.9).unwrap();
            Se3::new(turn, [0.1, f64::from(id), 1.0 / 3.0].into())
        }),
    };
    ChunkViews { id: ChunkId(id), views: (0..4).map(view).collect() }
}

/// What the model says here.
pub fn local(views: &ChunkViews, wanted: Range<usize>) -> Predicted {
    Brightness(facts("bright")).predict("{}", true, views, wanted, &|_| false).unwrap()
}

pub fn same_bits(found: &Predicted, here: &Predicted) -> bool {
    let bits = |image: &Image<f32>| image.data().iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    found.tokens == here.tokens
        && found.geometry.frame == here.geometry.frame
        && found.geometry.views.len() == here.geometry.views.len()
        && found.geometry.views.iter().zip(&here.geometry.views).all(|(a, b)| {
            (a.frame_id, a.chunk_from_camera, a.intrinsics) == (b.frame_id, b.chunk_from_camera, b.intrinsics)
                && bits(a.depth.image()) == bits(b.depth.image())
                && bits(a.confidence.image()) == bits(b.confidence.image())
        })
}
