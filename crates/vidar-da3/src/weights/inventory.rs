//! Which tensors a checkpoint of a given configuration holds: name, shape, and whether inference reads them.
//!
//! The list is the one of the official files (`model.safetensors`), key by key. In the DualDPT head the four
//! `output_conv2_aux.{0..3}.2` norms are one shared module, stored once under level 0.

use crate::config::{CameraEncoderConfig, Da3Config, Ffn, HEAD_LAST, HeadKind, NetConfig, Networks, PATCH};

/// One tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// Full key, `model.` included.
    pub name: String,
    /// Shape as stored.
    pub shape: Vec<usize>,
    /// Whether any path of inference reads it; the others may be absent.
    pub is_read: bool,
}

/// Every tensor of a model, in the order of the module tree.
pub fn parameters(config: &Da3Config) -> Vec<Parameter> {
    let mut list = List { parameters: Vec::new(), is_read: true };
    match &config.networks {
        Networks::Single(net) => list.network(net, SINGLE),
        Networks::Nested { any_view, metric } => {
            list.network(any_view, NESTED_ANY_VIEW);
            list.network(metric, NESTED_METRIC);
        }
    }
    list.parameters
}

/// Prefix of the keys of a single network.
pub const SINGLE: &str = "model";
/// Prefix of the keys of a nested model's any-view network.
pub const NESTED_ANY_VIEW: &str = "model.da3";
/// Prefix of the keys of a nested model's metric network.
pub const NESTED_METRIC: &str = "model.da3_metric";

/// Whether a key belongs to a part that inference of geometry does not use (the Gaussian head).
pub fn is_ignored(name: &str) -> bool {
    name.split('.').any(|part| part == "gs_head" || part == "gs_adapter")
}

/// The stored name of a tensor that some converters write under an alias (the shared norm); `None` when `name` is no alias.
pub fn stored_name(name: &str) -> Option<String> {
    let (head, rest) = name.split_once("scratch.output_conv2_aux.")?;
    let (level, leaf) = rest.split_once('.')?;
    let shared = matches!(level, "1" | "2" | "3") && (leaf == "2.weight" || leaf == "2.bias");
    shared.then(|| format!("{head}scratch.output_conv2_aux.0.{leaf}"))
}

struct List {
    parameters: Vec<Parameter>,
    is_read: bool,
}

impl List {
    fn tensor(&mut self, name: String, shape: &[usize]) {
        self.parameters.push(Parameter { name, shape: shape.to_vec(), is_read: self.is_read });
    }

    fn optional(&mut self, is_read: bool, add: impl FnOnce(&mut Self)) {
        let before = self.is_read;
        self.is_read = before && is_read;
        add(self);
        self.is_read = before;
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.tensor(format!("{name}.weight"), &[outputs, inputs]);
        self.tensor(format!("{name}.bias"), &[outputs]);
    }

    fn norm(&mut self, name: &str, channels: usize) {
        self.tensor(format!("{name}.weight"), &[channels]);
        self.tensor(format!("{name}.bias"), &[channels]);
    }

    fn conv(&mut self, name: &str, inputs: usize, outputs: usize, side: usize) {
        self.tensor(format!("{name}.weight"), &[outputs, inputs, side, side]);
        self.tensor(format!("{name}.bias"), &[outputs]);
    }

    fn network(&mut self, net: &NetConfig, root: &str) {
        self.backbone(net, &format!("{root}.backbone.pretrained"));
        if let Some(encoder) = &net.camera_encoder {
            self.camera_encoder(encoder, net.backbone.dim, &format!("{root}.cam_enc"));
        }
        if net.camera_decoder {
            self.camera_decoder(net.backbone.feature_dim(), &format!("{root}.cam_dec"));
        }
        self.head(net, &format!("{root}.head"));
    }

    fn backbone(&mut self, net: &NetConfig, root: &str) {
        let b = &net.backbone;
        self.tensor(format!("{root}.cls_token"), &[1, 1, b.dim]);
        if b.alternate_from.is_some() {
            self.tensor(format!("{root}.camera_token"), &[1, 2, b.dim]);
        }
        self.tensor(format!("{root}.pos_embed"), &[1, 1 + b.position_grid * b.position_grid, b.dim]);
        self.conv(&format!("{root}.patch_embed.proj"), 3, b.dim, PATCH);
        for i in 0..b.depth {
            let block = format!("{root}.blocks.{i}");
            self.block(&block, b.dim, b.ffn);
            if b.has_qk_norm(i) {
                self.norm(&format!("{block}.attn.q_norm"), b.head_dim());
                self.norm(&format!("{block}.attn.k_norm"), b.head_dim());
            }
        }
        self.norm(&format!("{root}.norm"), b.dim);
    }

    fn block(&mut self, root: &str, dim: usize, ffn: Ffn) {
        self.norm(&format!("{root}.norm1"), dim);
        self.linear(&format!("{root}.attn.qkv"), dim, 3 * dim);
        self.linear(&format!("{root}.attn.proj"), dim, dim);
        self.tensor(format!("{root}.ls1.gamma"), &[dim]);
        self.norm(&format!("{root}.norm2"), dim);
        match ffn {
            Ffn::Mlp { hidden } => {
                self.linear(&format!("{root}.mlp.fc1"), dim, hidden);
                self.linear(&format!("{root}.mlp.fc2"), hidden, dim);
            }
            Ffn::SwiGlu { hidden } => {
                self.linear(&format!("{root}.mlp.w12"), dim, 2 * hidden);
                self.linear(&format!("{root}.mlp.w3"), hidden, dim);
            }
        }
        self.tensor(format!("{root}.ls2.gamma"), &[dim]);
    }

    fn camera_encoder(&mut self, encoder: &CameraEncoderConfig, dim: usize, root: &str) {
        self.linear(&format!("{root}.pose_branch.fc1"), 9, dim / 2);
        self.linear(&format!("{root}.pose_branch.fc2"), dim / 2, dim);
        self.norm(&format!("{root}.token_norm"), dim);
        for i in 0..encoder.depth {
            self.block(&format!("{root}.trunk.{i}"), dim, Ffn::Mlp { hidden: encoder.mlp_ratio * dim });
        }
        self.norm(&format!("{root}.trunk_norm"), dim);
    }

    fn camera_decoder(&mut self, dim: usize, root: &str) {
        self.linear(&format!("{root}.backbone.0"), dim, dim);
        self.linear(&format!("{root}.backbone.2"), dim, dim);
        self.linear(&format!("{root}.fc_t"), dim, 3);
        self.linear(&format!("{root}.fc_qvec"), dim, 4);
        self.linear(&format!("{root}.fc_fov.0"), dim, 2);
    }

    fn head(&mut self, net: &NetConfig, root: &str) {
        let (input, features) = (net.backbone.feature_dim(), net.head.features);
        let channels = net.head.out_channels;
        let is_dual = net.head.kind == HeadKind::DualDpt;
        if is_dual {
            self.norm(&format!("{root}.norm"), input);
        }
        for (k, &c) in channels.iter().enumerate() {
            self.conv(&format!("{root}.projects.{k}"), input, c, 1);
        }
        for (k, side) in [(0, 4), (1, 2), (3, 3)] {
            self.conv(&format!("{root}.resize_layers.{k}"), channels[k], channels[k], side);
        }
        let scratch = format!("{root}.scratch");
        for (k, &c) in channels.iter().enumerate() {
            self.tensor(format!("{scratch}.layer{}_rn.weight", k + 1), &[features, c, 3, 3]);
        }
        self.fusion_chain(&scratch, "", features);
        self.conv(&format!("{scratch}.output_conv1"), features, features / 2, 3);
        self.conv(&format!("{scratch}.output_conv2.0"), features / 2, HEAD_LAST, 3);
        self.conv(&format!("{scratch}.output_conv2.2"), HEAD_LAST, if is_dual { 2 } else { 1 }, 1);
        if is_dual {
            self.fusion_chain(&scratch, "_aux", features);
            self.rays(&scratch, features);
        } else {
            self.conv(&format!("{scratch}.sky_output_conv2.0"), features / 2, HEAD_LAST, 3);
            self.conv(&format!("{scratch}.sky_output_conv2.2"), HEAD_LAST, 1, 1);
        }
    }

    fn fusion_chain(&mut self, scratch: &str, suffix: &str, features: usize) {
        for level in (1..=4).rev() {
            let block = format!("{scratch}.refinenet{level}{suffix}");
            let units: &[&str] =
                if level == 4 { &["resConfUnit2"] } else { &["resConfUnit1", "resConfUnit2"] };
            for unit in units {
                self.conv(&format!("{block}.{unit}.conv1"), features, features, 3);
                self.conv(&format!("{block}.{unit}.conv2"), features, features, 3);
            }
            self.conv(&format!("{block}.out_conv"), features, features, 1);
        }
    }

    /// Only level 3 of the ray branch is read; its norm is the one stored under level 0.
    fn rays(&mut self, scratch: &str, features: usize) {
        for level in 0..4 {
            self.optional(level == 3, |list| {
                for i in 0..5 {
                    let (inputs, outputs) =
                        if i % 2 == 0 { (features, features / 2) } else { (features / 2, features) };
                    list.conv(&format!("{scratch}.output_conv1_aux.{level}.{i}"), inputs, outputs, 3);
                }
                list.conv(&format!("{scratch}.output_conv2_aux.{level}.0"), features / 2, HEAD_LAST, 3);
                list.conv(&format!("{scratch}.output_conv2_aux.{level}.5"), HEAD_LAST, 7, 1);
            });
        }
        self.norm(&format!("{scratch}.output_conv2_aux.0.2"), HEAD_LAST);
    }
}
