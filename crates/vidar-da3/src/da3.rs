//! An open model: [`Da3`].

use crate::arithmetic::{Arithmetic, Precision};
use crate::config::{Da3Config, Variant, json};
use crate::device::{self, Device, OpenDevice};
use crate::error::Da3Error;
use crate::model::{DeviceLoader, DevicePlan, Model};
use crate::run::{Hooks, Run};
use crate::weights::{Residency, SyntheticWeights, detect, verify};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_nn::{Checkpoint, Compute, Isa, WeightSource};

/// How a model computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Da3Options {
    /// Matrix products of the backbone. `auto` is bf16 where the processor multiplies it and `f32` elsewhere.
    pub precision: Precision,
    /// Matrix products of the dense head; `None` is `f32` beside a bf16 backbone, as in the official code, and the
    /// backbone's precision otherwise.
    pub head_precision: Option<Precision>,
    /// With a bf16 backbone: how many of its leading blocks (and, unless none, the patch embedding) stay in `f32`.
    /// `None` is a third of them, or all but twenty, which bounds the largest error of depth; 0 is fastest.
    pub exact_blocks: Option<usize>,
    /// Where backbone and dense head are computed.
    pub device: Device,
    /// Most bytes of device memory held at a time; `None` is no limit.
    pub max_device_bytes: Option<u64>,
    /// The kernel set; `None` is the fastest of this machine.
    pub isa: Option<Isa>,
    /// Whether synthetic weights stay in memory. Files are mapped and cost nothing either way.
    pub residency: Residency,
}

/// Depth Anything 3, ready to run. It can be shared between threads; runs do not influence each other.
pub struct Da3 {
    pub(crate) config: Da3Config,
    pub(crate) model: Model,
    backbone: Compute,
    head: Compute,
    arithmetic: Arithmetic,
    opened: Option<OpenDevice>,
    origin: WeightsOrigin,
}

/// Where the weights of an open model come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WeightsOrigin {
    /// A file.
    File {
        /// Its path.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
    /// Generated: the predicted geometry is meaningless.
    Synthetic,
    /// Supplied by the caller.
    External,
}

const WEIGHTS_FILE: &str = "model.safetensors";
const CONFIG_FILE: &str = "config.json";

impl Da3 {
    /// Opens a folder with `model.safetensors` and `config.json` as published on the hub, or a safetensors file (with a
    /// `config.json` beside it, if there is one). Without a `config.json` the network is recognised by its keys.
    pub fn open(path: &Path, options: &Da3Options) -> Result<Self, Da3Error> {
        let (weights, description) = locate(path)?;
        let described = match description {
            Some(file) => Some(json::parse(&read_config(&file)?, &file.display().to_string())?),
            None => None,
        };
        let checkpoint = Checkpoint::open(&weights)?;
        let config = match described {
            Some(config) => config,
            None => detect(&checkpoint)?.config(),
        };
        verify(&checkpoint, &config)?;
        let bytes = checkpoint.file_bytes() as u64;
        let origin = WeightsOrigin::File { path: weights, bytes };
        let source: Arc<dyn WeightSource> = Arc::new(checkpoint);
        Self::load(config, &source, options, origin)
    }

    /// A model with weights from any source.
    pub fn with_weights(
        config: Da3Config,
        source: Arc<dyn WeightSource>,
        options: &Da3Options,
    ) -> Result<Self, Da3Error> {
        Self::load(config, &source, options, WeightsOrigin::External)
    }

    /// An official variant with synthetic weights, for tests and timings: its geometry is meaningless.
    pub fn synthetic(variant: Variant, options: &Da3Options) -> Result<Self, Da3Error> {
        Self::synthetic_of(variant.config(), options)
    }

    /// As [`Da3::synthetic`], for any network.
    pub fn synthetic_of(config: Da3Config, options: &Da3Options) -> Result<Self, Da3Error> {
        let source: Arc<dyn WeightSource> = Arc::new(SyntheticWeights);
        Self::load(config, &source, options, WeightsOrigin::Synthetic)
    }

    fn load(
        config: Da3Config,
        source: &Arc<dyn WeightSource>,
        options: &Da3Options,
        origin: WeightsOrigin,
    ) -> Result<Self, Da3Error> {
        config.validate()?;
        let isa = options.isa.unwrap_or_else(Isa::detect);
        let opened = device::open(options.device, options.max_device_bytes)?;
        let (precision, head, exact) = (options.precision, options.head_precision, options.exact_blocks);
        let arithmetic = match &opened {
            Some(_) => Arithmetic::on_device(precision, head, isa, exact),
            None => Arithmetic::resolve(precision, head, isa, exact),
        };
        let backbone = Compute::with_isa(isa, arithmetic.backbone)?;
        let loader = opened.as_ref().map(|device| device.loader(arithmetic));
        let loader = loader.as_ref().map(|loader| loader as &dyn DeviceLoader);
        Ok(Self {
            model: Model::load(source, &config, options.residency, loader)?,
            opened,
            config,
            backbone,
            head: backbone.at(arithmetic.head),
            arithmetic,
            origin,
        })
    }

    /// The networks of the model.
    pub fn config(&self) -> &Da3Config {
        &self.config
    }

    /// The origin of its weights.
    pub fn origin(&self) -> &WeightsOrigin {
        &self.origin
    }

    /// Kernels and precisions: the options resolved for this machine.
    pub fn arithmetic(&self) -> Arithmetic {
        self.arithmetic
    }

    /// The name of the device that backbone and head are computed on; `None` is the CPU.
    pub fn device_name(&self) -> Option<String> {
        self.opened.as_ref().map(OpenDevice::name)
    }

    /// Device memory for `views` views at `height` × `width` processed pixels; `None` is the CPU
    /// ([`Da3::memory_estimate`]).
    pub fn device_plan(
        &self,
        views: usize,
        height: usize,
        width: usize,
        wants_rays: bool,
    ) -> Option<DevicePlan> {
        let size = (views, height, width);
        self.opened.as_ref().map(|device| device.plan(&self.config, size, wants_rays))
    }

    /// The most bytes of device memory held at a time since the network was opened, as counted by its buffers; `None` is the
    /// CPU.
    pub fn device_peak_bytes(&self) -> Option<u64> {
        self.opened.as_ref().map(OpenDevice::peak_bytes)
    }

    /// Kernels, precisions and device as text.
    pub fn describe_compute(&self) -> String {
        match self.device_name() {
            Some(name) => format!("{} ({name})", self.arithmetic),
            None => self.arithmetic.to_string(),
        }
    }

    /// The device that backbone and head are computed on, if it is not the CPU.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> Option<&vidar_gpu::Gpu> {
        self.opened.as_ref().map(OpenDevice::gpu)
    }

    /// Kernels and precision of the backbone.
    pub fn compute(&self) -> Compute {
        self.backbone
    }

    /// Whether it takes several views at once and predicts cameras.
    pub fn is_any_view(&self) -> bool {
        self.config.main().is_any_view()
    }

    pub(crate) fn run<'a>(&self, hooks: &Hooks<'a>) -> Run<'a> {
        Run {
            backbone: self.backbone,
            exact_blocks: self.arithmetic.exact_blocks,
            head: self.head,
            watch: hooks.watch,
            share: (0.0, 1.0),
            trace: hooks.trace,
        }
    }
}

fn locate(path: &Path) -> Result<(PathBuf, Option<PathBuf>), Da3Error> {
    let weights = if path.is_dir() { path.join(WEIGHTS_FILE) } else { path.to_path_buf() };
    if !weights.is_file() {
        return Err(Da3Error::NoModel { path: path.to_path_buf() });
    }
    let description = weights.parent().map(|folder| folder.join(CONFIG_FILE)).filter(|file| file.is_file());
    Ok((weights, description))
}

fn read_config(file: &Path) -> Result<String, Da3Error> {
    let io = |source| Da3Error::Io { path: file.to_path_buf(), source };
    let bytes = std::fs::metadata(file).map_err(io)?.len();
    if bytes > json::MAX_BYTES {
        let place = file.display().to_string();
        return Err(Da3Error::ConfigTooLarge { place, bytes, max: json::MAX_BYTES });
    }
    std::fs::read_to_string(file).map_err(io)
}
