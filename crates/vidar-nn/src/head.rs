//! The end of a dense prediction head in one pass over row bands.

use rayon::prelude::*;

use crate::compute::{Compute, Precision};
use crate::conv::{Conv2d, MapRef};
use crate::kernels::centre::{Bias, centre_of};
use crate::kernels::head::{Band, Branch, Part};
use crate::kernels::pack::Pack;
use crate::kernels::resample::Resampled;
use crate::kernels::scratch::{self, Role};
use crate::kernels::shape::{Shape, ShapeOf};
use crate::kernels::shared::SharedMut;
use crate::kernels::source::{Fill, Source};
use crate::kernels::{Factors, dispatch_product, winograd};
use crate::norm::LayerNorm;
use crate::resize::{Corners, GridEmbedding, MapSize, taps};

/// The map that the branches of a head share.
#[derive(Debug, Clone, Copy)]
pub struct HeadInput<'a> {
    /// The map `[rows, cols, channels]`, before resampling.
    pub map: MapRef<'a>,
    /// Its channels.
    pub channels: usize,
    /// What it is resampled to; the map's own size for none.
    pub size: MapSize,
    /// How it is resampled.
    pub corners: Corners,
    /// What is added after resampling.
    pub embedding: Option<&'a GridEmbedding>,
}

/// One branch: `out = point(relu(norm(conv(input))))`.
#[derive(Debug)]
pub struct HeadBranch<'a> {
    /// A convolution that keeps rows and columns.
    pub conv: &'a Conv2d,
    /// A layer norm over its channels, before the relu.
    pub norm: Option<&'a LayerNorm>,
    /// A 1×1 convolution.
    pub point: &'a Conv2d,
    /// `[size.rows, size.cols, point.out_channels()]`
    pub out: &'a mut [f32],
}

/// Resamples a map, adds an embedding and takes it through all branches. No map of the full size is stored but the
/// branches' outputs.
///
/// # Panics
/// When a slice has another length, or the layers of a branch do not fit to each other.
pub fn head(c: &Compute, input: &HeadInput<'_>, branches: &mut [HeadBranch<'_>]) {
    let (map, size, channels) = (input.map, input.size, input.channels);
    assert_eq!(map.data.len(), map.rows * map.cols * channels, "head: input");
    let embedding = input.embedding.map(|e| e.view(channels, size));
    let (isa, factors) = (c.isa(), Factors::of(c));
    let mut lengths = Vec::with_capacity(branches.len());
    for branch in branches.iter() {
        let (conv, point) = (branch.conv, branch.point);
        assert_eq!(conv.in_channels(), channels, "head: channels of a convolution");
        assert!(
            conv.keeps_size() && point.is_pointwise(),
            "head: a convolution that keeps the size, then a 1x1"
        );
        assert_eq!(point.in_channels(), conv.out_channels(), "head: channels between the convolutions");
        assert!(
            branch.norm.is_none_or(|norm| norm.features() == conv.out_channels()),
            "head: channels of the norm"
        );
        assert_eq!(branch.out.len(), size.rows * size.cols * point.out_channels(), "head: output");
        let bands = conv.bands(Fill::Copy(&[]), size.rows, size.cols);
        let inner = Source::Bands(bands).inner();
        let Shape { panel, words } = dispatch_product(isa, factors, ShapeOf { inner });
        let is_in_tiles = winograd::is_for(&bands, factors);
        let words = if is_in_tiles { winograd::panel_words(channels, panel) } else { panel * words };
        lengths.push((panel, conv.out_channels().div_ceil(panel) * words));
    }
    if size.rows * size.cols * channels == 0 {
        for branch in branches {
            branch.out.fill(0.0);
        }
        return;
    }
    assert!(!map.data.is_empty(), "head: a map without pixels");

    let Some(conv) = branches.first().map(|branch| branch.conv) else { return };
    assert!(
        branches.iter().all(|b| b.conv.weight().shape()[2..] == conv.weight().shape()[2..]),
        "head: equal kernels"
    );
    let (ys, xs) = (taps(map.rows, size.rows, input.corners), taps(map.cols, size.cols, input.corners));
    let resampled = Resampled { x: map.data, cols: map.cols, channels, ys: &ys, xs: &xs, embedding };
    let bands = conv.bands(Fill::Resampled(&resampled), size.rows, size.cols);
    let source = Source::Bands(bands);
    let is_in_tiles = winograd::is_for(&bands, factors);

    let centre = centre_of(isa, factors, &source);
    let mut packed = scratch::borrow(Role::Panels);
    let total: usize = lengths.iter().map(|(_, length)| length).sum();
    let mut rest = &mut packed.words(total)[..total];
    let mut panels: Vec<(&[u32], Bias<'_>)> = Vec::with_capacity(branches.len());
    for (branch, (panel, len)) in branches.iter().zip(&lengths) {
        let (to, after) = rest.split_at_mut(*len);
        rest = after;
        let mut bias = Bias::new(branch.conv.bias(), centre.as_deref(), branch.conv.out_channels());
        if is_in_tiles {
            winograd::pack(c, branch.conv, channels, 0..branch.conv.out_channels(), *panel, to);
            panels.push((to, bias));
            continue;
        }
        let pack = Pack {
            columns: branch.conv,
            column: &|at| (at < branch.conv.out_channels()).then_some(at),
            inner: source.inner(),
            round_to_f16: c.precision() == Precision::F16,
            centre: centre.as_deref().zip(bias.products()),
            first: 0,
            to: &mut *to,
        };
        pack.run(isa, factors);
        panels.push((to, bias));
    }
    let points: Vec<Vec<f32>> = branches.iter().map(|branch| branch.point.weight().to_f32()).collect();
    let branches: Vec<Branch<'_>> = branches
        .iter_mut()
        .zip(&panels)
        .zip(&points)
        .map(|((branch, (panels, bias)), point)| Branch {
            panels,
            middle: branch.conv.out_channels(),
            bias: bias.get(),
            norm: branch.norm.map(LayerNorm::view),
            point,
            point_bias: branch.point.bias(),
            outputs: branch.point.out_channels(),
            out: SharedMut::new(branch.out),
        })
        .filter(|branch| branch.middle > 0 && branch.outputs > 0)
        .collect();
    let (branches, centre) = (&branches[..], centre.as_deref());
    let run = |part| dispatch_product(isa, factors, Band { bands, branches, part, centre });
    if is_in_tiles {
        let plan = winograd::Plan::new(&bands);
        (0..plan.tasks).into_par_iter().for_each(|task| run(Part::Tiles(plan.range(task, &bands))));
    } else {
        (0..source.chunks()).into_par_iter().for_each(|chunk| run(Part::Chunk(chunk)));
    }
}
