//! The network on normalised pixels: what is between preprocessing and alignment.

use super::InferOptions;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::model::backbone::Pixels;
use crate::model::{AnyView, Model, Nested, Request, SingleViewOutput, scale_to_metres};
use crate::pose::{self, Cameras, NetCameras};
use crate::ray_pose::{RayMap, camera_from_rays, sample_table};
use crate::run::{Hooks, Run};
use nalgebra::{Matrix3, Matrix4};
use std::collections::BTreeMap;
use std::ops::Range;

/// What a network says about normalised pixels, all views one after the other.
#[derive(Clone, Debug)]
pub struct NetOutput {
    /// Views for which there is depth, as asked for.
    pub wanted: Range<usize>,
    /// `[wanted, H, W]`.
    pub depth: Vec<f32>,
    /// `[wanted, H, W]`, at least 1.
    pub confidence: Option<Vec<f32>>,
    /// `[wanted, H, W]`, 0 for what is not sky.
    pub sky: Option<Vec<f32>>,
    /// Predicted poses of all views.
    pub camera_from_world: Option<Vec<Matrix4<f64>>>,
    /// Predicted intrinsics of all views, pixels, origin at the edge.
    pub intrinsics: Option<Vec<Matrix3<f64>>>,
    /// Rays of the wanted views, if asked for.
    pub rays: Option<Vec<RayMap>>,
    /// Metres per unit that a nested model multiplied depth by.
    pub scale_factor: Option<f64>,
    /// By layer and view: normalised patch tokens `[patches, D]`.
    pub layers: BTreeMap<usize, Vec<Vec<f32>>>,
    /// The view in whose camera frame the answer is.
    pub reference: usize,
}

impl Da3 {
    /// Runs the network on normalised pixels; `cameras` as [`pose::normalise_world`] makes them.
    pub fn forward(
        &self,
        pixels: &Pixels<'_>,
        cameras: Option<NetCameras<'_>>,
        options: &InferOptions,
        hooks: &Hooks<'_>,
    ) -> Result<NetOutput, Da3Error> {
        let run = self.run(hooks);
        let depth = self.config.main().backbone.depth;
        if let Some(layer) = options.feature_layers.iter().find(|l| **l >= depth) {
            let reason = format!("layer {layer} of {depth}");
            return Err(Da3Error::BadInput { what: "feature_layers", reason });
        }
        match &self.model {
            Model::AnyView(net) => {
                let wanted = options.wanted.clone().unwrap_or(0..pixels.views);
                any_view(net, &run, pixels, cameras, (options, wanted))
            }
            Model::SingleView(net) => {
                self.refuse_for_single_views(cameras.is_some(), options)?;
                let answer = net.run(&run, pixels, &options.feature_layers)?;
                Ok(NetOutput {
                    wanted: 0..pixels.views,
                    depth: answer.depth,
                    confidence: None,
                    sky: Some(answer.sky),
                    camera_from_world: None,
                    intrinsics: None,
                    rays: None,
                    scale_factor: None,
                    layers: answer.layers,
                    reference: 0,
                })
            }
            Model::Nested { any_view: net, metric } => {
                let mut output = any_view(net, &run, pixels, cameras, (options, 0..pixels.views))?;
                // The two networks' intermediate results have the same names: only their ends are shown.
                let answer = metric.run(&Run { trace: None, ..run }, pixels, &[])?;
                show_ends(&run, pixels, &output, &answer);
                let missing = || Da3Error::Degenerate {
                    step: "metric scale",
                    reason: "the any-view network gave no cameras".into(),
                };
                let scale = scale_to_metres(Nested {
                    depth: &mut output.depth,
                    confidence: output.confidence.as_mut().ok_or_else(missing)?,
                    camera_from_world: output.camera_from_world.as_mut().ok_or_else(missing)?,
                    intrinsics: output.intrinsics.as_ref().ok_or_else(missing)?,
                    canonical: &answer.depth,
                    sky: &answer.sky,
                })?;
                Ok(NetOutput { scale_factor: Some(scale), ..output })
            }
        }
    }

    fn refuse_for_single_views(&self, has_cameras: bool, options: &InferOptions) -> Result<(), Da3Error> {
        let what = match (has_cameras, options.use_ray_pose || options.wants_rays) {
            (true, _) => "given cameras",
            (_, true) => "rays",
            _ => return Ok(()),
        };
        let reason = format!("{} is a network of single views", self.config.name);
        Err(Da3Error::BadInput { what, reason })
    }
}

fn show_ends(run: &Run<'_>, pixels: &Pixels<'_>, output: &NetOutput, answer: &SingleViewOutput) {
    let shape = [pixels.rows, pixels.columns];
    let confidence = output.confidence.as_deref().unwrap_or_default();
    let ends: [(&str, &[f32]); 4] = [
        ("any.depth", &output.depth),
        ("any.depth_conf", confidence),
        ("metric.depth", &answer.depth),
        ("metric.sky", &answer.sky),
    ];
    for (name, values) in ends {
        for (view, values) in values.chunks_exact(shape[0] * shape[1]).enumerate() {
            run.show(name, view, &shape, values);
        }
    }
}

fn any_view(
    net: &AnyView,
    run: &Run<'_>,
    pixels: &Pixels<'_>,
    cameras: Option<NetCameras<'_>>,
    (options, wanted): (&InferOptions, Range<usize>),
) -> Result<NetOutput, Da3Error> {
    let wants_rays = options.wants_rays || options.use_ray_pose;
    let request = Request {
        cameras,
        strategy: options.reference,
        wants_rays,
        layers: &options.feature_layers,
        // A pose from rays needs the rays of every view.
        wanted: if options.use_ray_pose { 0..pixels.views } else { wanted.clone() },
    };
    let answer = net.run(run, pixels, &request)?;
    let (width, height) = (pixels.columns, pixels.rows);
    let mut cameras = answer.codes.map(|codes| decode(&codes, width, height));
    let mut views = answer.views;
    if options.use_ray_pose {
        let mut found = Cameras::default();
        for map in views.iter().filter_map(|v| v.rays.as_ref()) {
            run.check_cancelled()?;
            let camera = camera_from_rays(map, &sample_table(map.rows * map.columns))?;
            found.intrinsics.push(camera.intrinsics(width, height));
            found.camera_from_world.push(camera.camera_from_world);
        }
        cameras = Some(found);
        views = views.drain(wanted.clone()).collect();
    }
    let mut layers = answer.layers;
    if options.compat {
        // The reference first, as the blocks had it.
        layers.values_mut().for_each(|views| views[..=answer.reference].rotate_right(1));
    }
    let (camera_from_world, intrinsics) = cameras.map(|c| (c.camera_from_world, c.intrinsics)).unzip();
    let area = width * height;
    let (mut depth, mut confidence) =
        (Vec::with_capacity(views.len() * area), Vec::with_capacity(views.len() * area));
    let mut rays = Vec::new();
    for view in views {
        depth.extend(view.depth);
        confidence.extend(view.confidence);
        rays.extend(view.rays);
    }
    Ok(NetOutput {
        wanted,
        depth,
        confidence: Some(confidence),
        sky: None,
        camera_from_world,
        intrinsics,
        rays: wants_rays.then_some(rays),
        scale_factor: None,
        layers,
        reference: answer.reference,
    })
}

fn decode(codes: &[[f64; 9]], width: usize, height: usize) -> Cameras {
    let (camera_from_world, intrinsics) = codes.iter().map(|code| pose::decode(code, width, height)).unzip();
    Cameras { camera_from_world, intrinsics }
}
