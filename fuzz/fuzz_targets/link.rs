//! What comes from other machines: questions, requests, replies, attachments, keys. The first byte picks.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::ops::Range;
use std::sync::OnceLock;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, Confidence, FrameId, FrameImage, GeometryPrediction, Image, ModelInfo,
    Pinhole, RelativeDepth, Se3, Timestamp, ViewGeometry, Watch,
};
use vidar_link::geometry::{
    DepthFormat, Hello, ModelFacts, Outcome, PredictReply, PredictRequest, Predicted, Served, answer_hello,
    answer_predict,
};
use vidar_link::ros::{Attachment, TopicKey};

/// A model that answers with a wall.
struct Wall;

impl Served for Wall {
    fn facts(&self, _: &str) -> Result<ModelFacts, String> {
        let (name, licence) = ("wall".to_owned(), "MIT".to_owned());
        let info = ModelInfo {
            name: name.clone(),
            licence: licence.clone(),
            weights_sha256: None,
            needs_poses: false,
            min_views: 1,
        };
        Ok(ModelFacts { model: name, licence, info, token_channels: None, arithmetic: String::new() })
    }

    fn predict(
        &self,
        _: &str,
        _: bool,
        views: &ChunkViews,
        wanted: Range<usize>,
        _: Watch<'_>,
    ) -> Result<Predicted, String> {
        let view = |v: &ChunkView| ViewGeometry {
            frame_id: v.frame_id,
            chunk_from_camera: v.world_from_camera.unwrap_or(Se3::IDENTITY),
            intrinsics: v.intrinsics,
            depth: RelativeDepth::new(Image::filled(v.image.width(), v.image.height(), 1.0)),
            confidence: Confidence::full(v.image.width(), v.image.height()),
        };
        let views = views.views[wanted].iter().map(view).collect();
        let geometry = GeometryPrediction { chunk_id: ChunkId(0), frame: ChunkFrame::PriorWorld, views };
        Ok(Predicted { geometry, tokens: Vec::new() })
    }
}

fn asked() -> &'static PredictRequest {
    static ASKED: OnceLock<PredictRequest> = OnceLock::new();
    ASKED.get_or_init(|| {
        let view = |i| ChunkView {
            frame_id: FrameId(i),
            time: Timestamp::from_nanos(0),
            image: FrameImage::Gray8(Image::filled(4, 3, 7)),
            intrinsics: Pinhole { fx: 4.0, fy: 4.0, cx: 1.5, cy: 1.0, width: 4, height: 3 },
            world_from_camera: None,
        };
        PredictRequest {
            run: 1,
            number: 1,
            patience_ms: 1,
            settings: "{}".into(),
            weights_sha256: None,
            wants_tokens: true,
            depth: DepthFormat::F16,
            views: ChunkViews { id: ChunkId(0), views: (0..3).map(view).collect() },
            wanted: 0..3,
        }
    })
}

fuzz_target!(|data: &[u8]| {
    let Some((pick, bytes)) = data.split_first() else { return };
    match pick % 6 {
        0 => drop(Hello::decode(bytes)),
        1 => drop(answer_hello(bytes, &Wall, ("a", "b"), 0)),
        2 => assert!(!answer_predict(bytes, &Wall, 0, &|_| false).bytes.is_empty()),
        3 => {
            if let Ok(PredictReply { outcome: Outcome::Predicted(geometry, tokens), .. }) =
                PredictReply::decode(bytes, asked())
            {
                assert!(geometry.views.iter().all(|v| v.chunk_from_camera.is_finite()));
                assert!(tokens.iter().flatten().all(|t| t.is_finite()));
            }
        }
        4 => {
            if let Ok(read) = Attachment::decode(bytes) {
                assert_eq!(Attachment::decode(&read.encode()), Ok(read));
            }
        }
        _ => {
            if let Ok(key) =
                std::str::from_utf8(bytes).map_err(|_| ()).and_then(|k| TopicKey::parse(k).map_err(|_| ()))
            {
                assert!(key.topic.starts_with('/') && !key.message_type.contains("::"));
            }
        }
    }
});
