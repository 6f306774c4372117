//! Converts flags to values of the library; each is checked here or at its first use.

use crate::args::{EvalArgs, WorldArgs};
use crate::link_args::LinkArgs;
use crate::run_args::RunArgs;
use crate::shared_args::{BudgetArgs, ConfigArgs, InputArgs, OutputArgs};
use std::path::Path;
use vidar::config::Origin;
use vidar::core::{CameraId, Se3, So3};
use vidar::da3::Device;
use vidar::dataset::{CameraFlag, OpenOptions, TrajectoryReadOptions, body_named, decoder_named};
use vidar::run_folder::OutputLocation;
use vidar::synth::{FlightKind, SceneKind, Start, SynthConfig};
use vidar::{Error, Layered};

/// An error about a wrong flag, with a hint.
pub fn usage(what: impl Into<String>, hint: impl Into<String>) -> Error {
    Error::Usage { what: what.into(), hint: hint.into() }
}

/// The configuration with its layers.
pub fn layered(args: &ConfigArgs, default_preset: Option<&str>) -> Result<Layered, Error> {
    let mut layered = Layered::defaults()?;
    if let Some(name) = args.preset.as_deref().or(default_preset) {
        layered.preset(name)?;
    }
    if let Some(path) = &args.config {
        layered.file(path)?;
    }
    // A name that is no text is not ours; a value that is none is refused as the text that it resembles.
    let variables = std::env::vars_os()
        .filter_map(|(k, v)| Some((k.into_string().ok()?, v.to_string_lossy().into_owned())));
    layered.environment(variables)?;
    args.set.iter().try_for_each(|assignment| layered.set(assignment))?;
    Ok(layered)
}

/// Applies the input flags that are settings, too.
pub fn apply_input_flags(layered: &mut Layered, input: &InputArgs) -> Result<(), Error> {
    let flags: [(&str, &'static str, Option<f64>); 2] =
        [("input.start_secs", "--start", input.start), ("input.end_secs", "--end", input.end)];
    for (key, flag, value) in flags {
        if let Some(value) = value {
            layered.value(key, toml::Value::Float(value), Origin::Flag(flag))?;
        }
    }
    let whole = [
        ("input.camera", "--camera", input.camera.map(i64::from)),
        ("input.stride", "--stride", input.stride.and_then(|s| i64::try_from(s).ok())),
    ];
    for (key, flag, value) in whole {
        if let Some(value) = value {
            layered.value(key, toml::Value::Integer(value), Origin::Flag(flag))?;
        }
    }
    Ok(())
}

/// `--map`.
pub fn apply_map_flag(layered: &mut Layered, map: Option<&str>) -> Result<(), Error> {
    match map {
        Some(map) => layered.value("input.map", toml::Value::String(map.to_owned()), Origin::Flag("--map")),
        None => Ok(()),
    }
}

/// `--masks`.
pub fn apply_masks_flag(layered: &mut Layered, masks: Option<&str>) -> Result<(), Error> {
    match masks {
        Some(folder) => {
            layered.value("input.masks", toml::Value::String(folder.to_owned()), Origin::Flag("--masks"))
        }
        None => Ok(()),
    }
}

/// `--realtime` and `--time-budget` of `vidar run`.
pub fn apply_budget_flags(layered: &mut Layered, args: &BudgetArgs) -> Result<(), Error> {
    if args.realtime {
        layered.value("budget.realtime", toml::Value::Boolean(true), Origin::Flag("--realtime"))?;
    }
    if let Some(seconds) = args.time_budget {
        if !(seconds.is_finite() && seconds > 0.0) {
            return Err(usage(
                format!("--time-budget must be finite and positive, found {seconds}"),
                "give the seconds that the run may take",
            ));
        }
        layered.value("budget.seconds", toml::Value::Float(seconds), Origin::Flag("--time-budget"))?;
    }
    Ok(())
}

/// The flags of `vidar run` and `vidar live` that choose a model.
pub fn apply_model_flags(layered: &mut Layered, args: &RunArgs) -> Result<(), Error> {
    if let Some(mode) = &args.mode {
        layered.value("coupling.mode", toml::Value::String(mode.clone()), Origin::Flag("--mode"))?;
    }
    if let Some(size) = &args.memory_budget {
        let bytes = toml::Value::Integer(byte_count(size)?);
        layered.value("limits.memory_bytes", bytes, Origin::Flag("--memory-budget"))?;
    }
    apply_device_flag(layered, args.device)?;
    apply_link_flags(layered, &args.link)?;
    apply_source_flags(layered, args.geometry.as_deref(), args.model_dir.as_deref())
}

/// `--device`.
pub fn apply_device_flag(layered: &mut Layered, device: Option<Device>) -> Result<(), Error> {
    let Some(device) = device else { return Ok(()) };
    layered.value("model.device", toml::Value::String(device.to_string()), Origin::Flag("--device"))
}

/// `--connect`, `--listen`, `--link-config`.
pub fn apply_link_flags(layered: &mut Layered, link: &LinkArgs) -> Result<(), Error> {
    let config = link.link_config.iter().map(|p| p.display().to_string()).collect();
    for (key, flag, values) in [
        ("link.connect", "--connect", &link.connect),
        ("link.listen", "--listen", &link.listen),
        ("link.config", "--link-config", &config),
    ] {
        if !values.is_empty() {
            layered.value(key, toml::Value::String(values.join(",")), Origin::Flag(flag))?;
        }
    }
    Ok(())
}

/// `4GiB`, `800MB`, `1.5G`, or bytes.
fn byte_count(text: &str) -> Result<i64, Error> {
    let wrong =
        || usage(format!("--memory-budget {text:?} is not a size"), "write 4GiB, 800MB or a number of bytes");
    let split = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let number: f64 = text[..split].parse().map_err(|_| wrong())?;
    let unit = match text[split..].trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "kib" => 1024.0,
        "m" | "mb" => 1e6,
        "mib" => 1_048_576.0,
        "g" | "gb" => 1e9,
        "gib" => 1_073_741_824.0,
        _ => return Err(wrong()),
    };
    let bytes = number * unit;
    if bytes.is_finite() && (1.0..1e15).contains(&bytes) { Ok(bytes as i64) } else { Err(wrong()) }
}

/// The flags that choose a source of geometry.
pub fn apply_source_flags(
    layered: &mut Layered,
    geometry: Option<&str>,
    model_dir: Option<&Path>,
) -> Result<(), Error> {
    if let Some(source) = geometry {
        let source = toml::Value::String(source.to_owned());
        layered.value("geometry.source", source, Origin::Flag("--geometry"))?;
    }
    if let Some(dir) = model_dir {
        let dir = toml::Value::String(dir.display().to_string());
        layered.value("model.dir", dir, Origin::Flag("--model-dir"))?;
    }
    Ok(())
}

/// How the input is read.
pub fn open_options(input: &InputArgs) -> Result<OpenOptions, Error> {
    let mut options = OpenOptions {
        calibration: input.calibration.clone(),
        trajectory: input.trajectory.clone(),
        imu: input.imu.clone(),
        timestamps: input.timestamps.clone(),
        depth_scale: input.depth_scale,
        camera: CameraId(input.camera.unwrap_or(0)),
        ..OpenOptions::default()
    };
    options.topics = input.topics.iter().map(|t| t.parse()).collect::<Result<_, _>>()?;
    options.format = input.format.as_deref().map(str::parse).transpose()?;
    options.decoder = input.decoder.as_deref().map(decoder_named).transpose()?.unwrap_or_default();
    options.trajectory_format = input.trajectory_format.as_deref().map(str::parse).transpose()?;
    options.time_unit = input.time_unit.as_deref().map(str::parse).transpose()?;
    options.camera_model =
        input.camera_model.as_deref().map(str::parse::<CameraFlag>).transpose()?.map(|flag| flag.0);
    options.trajectory_body = input.trajectory_body.as_deref().map(body_named).transpose()?;
    options.depth_intrinsics = input.depth_intrinsics.as_deref().map(four).transpose()?;
    options.color_from_depth = input.color_from_depth.as_deref().map(motion).transpose()?;
    Ok(options)
}

/// How the trajectories of `vidar eval` are read.
pub fn trajectory_options(args: &EvalArgs) -> Result<TrajectoryReadOptions, Error> {
    let time_unit = args.time_unit.as_deref().map(str::parse).transpose()?;
    let times =
        args.timestamps.as_deref().map(|file| vidar::dataset::read_times(file, time_unit)).transpose()?;
    Ok(TrajectoryReadOptions {
        format: args.trajectory_format.as_deref().map(str::parse).transpose()?,
        body: args.trajectory_body.as_deref().map(body_named).transpose()?,
        time_unit,
        times,
    })
}

fn numbers(text: &str, flag: &str) -> Result<Vec<f64>, Error> {
    let parsed: Result<Vec<f64>, _> = text.split(',').map(|t| t.trim().parse()).collect();
    parsed.ok().filter(|v: &Vec<f64>| v.iter().all(|x| x.is_finite())).ok_or_else(|| {
        usage(format!("{flag} {text:?} is not a list of numbers"), "separate numbers by commas, no spaces")
    })
}

fn four(text: &str) -> Result<[f64; 4], Error> {
    let values = numbers(text, "--depth-intrinsics")?;
    <[f64; 4]>::try_from(values).map_err(|v| {
        usage(
            format!("--depth-intrinsics has {} numbers, expected 4", v.len()),
            "write fx,fy,cx,cy in pixels",
        )
    })
}

fn motion(text: &str) -> Result<Se3, Error> {
    let wrong =
        |why: String| usage(format!("--color-from-depth {why}"), "write tx,ty,tz or tx,ty,tz,qx,qy,qz,qw");
    let values = numbers(text, "--color-from-depth")?;
    match values[..] {
        [x, y, z] => Ok(Se3::from_translation([x, y, z].into())),
        [x, y, z, qx, qy, qz, qw] => So3::from_quaternion(qx, qy, qz, qw)
            .map(|rotation| Se3::new(rotation, [x, y, z].into()))
            .ok_or_else(|| wrong("has a zero quaternion".into())),
        _ => Err(wrong(format!("has {} numbers", values.len()))),
    }
}

/// Where results go.
pub fn place(output: &OutputArgs, name: &str) -> OutputLocation {
    match &output.output {
        Some(path) => OutputLocation::Exact { path: path.clone(), force: output.force },
        None => OutputLocation::Dated { base: ".".into(), name: name.to_owned() },
    }
}

/// The synthetic world of the flags.
pub fn world(args: &WorldArgs, mut world: SynthConfig) -> Result<SynthConfig, Error> {
    if let Some(seed) = args.seed {
        world.seed = seed;
    }
    if let Some(secs) = args.duration {
        world.duration_secs = secs;
    }
    if let Some(secs) = args.static_start {
        world.start = Start::Static { secs };
    }
    if let Some(scene) = &args.scene {
        world.scene = match scene.as_str() {
            "room" => SceneKind::Room,
            "hall" => SceneKind::Hall,
            "corridor" => SceneKind::Corridor,
            other => {
                return Err(usage(format!("--scene {other:?} is unknown"), "scenes: room, hall, corridor"));
            }
        };
    }
    if let Some(flight) = &args.flight {
        world.flight = match flight.as_str() {
            "sweep" => FlightKind::Sweep,
            "orbit" => FlightKind::Orbit,
            "aggressive" => FlightKind::Aggressive,
            "handheld" => FlightKind::Handheld,
            "handheld-lively" => FlightKind::HandheldLively,
            other => {
                return Err(usage(
                    format!("--flight {other:?} is unknown"),
                    "flights: sweep, orbit, aggressive, handheld, handheld-lively",
                ));
            }
        };
    }
    world.validate()?;
    Ok(world)
}
