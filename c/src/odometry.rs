//! Visual-inertial odometry: images and IMU samples in, one state per image out.

use crate::error::{VidarError, guarded, usage};
use crate::image::{VidarImage, text};
use std::collections::VecDeque;
use std::ffi::c_char;
use std::ptr;
use vidar::core::{
    AngularRate, CameraId, Duration, Frame, FrameId, FrameImage, Health, ImuNoise, ImuSample, Rig, RigCamera,
    Se3, SensorEvent, So3, SpecificForce, Timestamp,
};
use vidar::dataset::{CameraFlag, with_size};
use vidar::odometry_stage::{Odometry, OdometryOutput};
use vidar::{Error, Layered};

/// A camera on the rig.
#[repr(C)]
pub struct VidarCamera {
    /// As `--camera-model` takes it: "pinhole:fx,fy,cx,cy", "radtan:fx,fy,cx,cy,k1,k2,p1,p2", …; pixel (0, 0) is the centre of the
    /// top-left pixel.
    pub model: *const c_char,
    /// Columns of its images.
    pub width: u32,
    /// Rows of its images.
    pub height: u32,
    /// Position of the camera in the IMU's axes, metres.
    pub position_in_body: [f64; 3],
    /// Orientation: maps camera axes (x right, y down, z forward) to the IMU's axes; x, y, z, w.
    pub body_from_camera_xyzw: [f64; 4],
    /// t_imu - t_camera, s.
    pub time_offset_secs: f64,
}

/// Noise of an IMU in continuous time, as Kalibr and EuRoC state it.
#[repr(C)]
pub struct VidarImuNoise {
    /// rad/s/sqrt(Hz)
    pub gyro_noise_density: f64,
    /// rad/s^2/sqrt(Hz)
    pub gyro_random_walk: f64,
    /// m/s^2/sqrt(Hz)
    pub accel_noise_density: f64,
    /// m/s^3/sqrt(Hz)
    pub accel_random_walk: f64,
    /// Hz
    pub rate_hz: f64,
}

/// How far a state may be trusted.
#[repr(C)]
#[derive(Clone, Copy)]
pub enum VidarHealth {
    /// Metric.
    Ok,
    /// Metric, the scale's standard deviation still above two percent.
    ScaleConverging,
    /// Lengths are not metres, or there is no state yet.
    ScaleUnknown,
    /// Metric, few landmarks.
    LowFeatures,
    /// Propagated by the IMU alone.
    Degraded,
    /// Measurements contradict the state.
    Suspect,
    /// There is no state.
    Lost,
}

/// What is known after one image.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct VidarState {
    /// Time of the image, nanoseconds.
    pub time_ns: i64,
    /// Number of the image.
    pub frame: u32,
    /// Counts worlds: poses of different segments cannot be compared.
    pub segment: u32,
    /// Whether there is a state: if not, all that follows but `health` is zero.
    pub is_tracking: bool,
    /// Whether lengths are metres and images support the state.
    pub is_metric: bool,
    /// How far it may be trusted.
    pub health: VidarHealth,
    /// Of the body (IMU) in the world, metres; z is up.
    pub position_in_world: [f64; 3],
    /// x, y, z, w.
    pub world_from_body_xyzw: [f64; 4],
    /// m/s
    pub velocity_in_world: [f64; 3],
    /// rad/s
    pub gyro_bias: [f64; 3],
    /// m/s^2
    pub accel_bias: [f64; 3],
    /// 15 x 15, relative to the first pose of the segment: rotation in the body (rad), position (m), velocity (m/s), gyroscope bias,
    /// accelerometer bias.
    pub covariance: [f64; 225],
    /// Standard deviation of ln(scale); infinite while lengths are not metres.
    pub scale_std: f64,
}

/// Odometry of one camera and one IMU. One thread at a time may use it.
pub struct VidarOdometry {
    machine: Odometry,
    /// What is left after the end; `None` before.
    rest: Option<VecDeque<OdometryOutput>>,
}

/// What a call that may give a state returns: there is one, there is none, or the call failed.
const STATE: i32 = 1;
const NO_STATE: i32 = 0;
const FAILED: i32 = -1;

/// An odometry, or null. `imu` may be null: poses are then up to scale. `settings` is null, or texts such as
/// "odometry.max_landmarks=200" that end with a null pointer.
///
/// # Safety
/// Pointers are null or point to what is said; `error` is null or may be written to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_odometry_new(
    camera: *const VidarCamera,
    imu: *const VidarImuNoise,
    settings: *const *const c_char,
    error: *mut *mut VidarError,
) -> *mut VidarOdometry {
    // SAFETY: the caller's promise.
    let make = || unsafe {
        let camera = camera.as_ref().ok_or_else(|| usage("camera is null"))?;
        let rig = Rig { cameras: vec![rig_camera(camera)?], imu: imu.as_ref().map(noise) };
        let mut layered = Layered::defaults()?;
        let mut next = settings;
        while !next.is_null() && !(*next).is_null() {
            layered.set(text("a setting", *next)?)?;
            next = next.add(1);
        }
        let machine = Odometry::new(&rig, CameraId(0), &layered.build()?.odometry)?;
        Ok(Box::into_raw(Box::new(VidarOdometry { machine, rest: None })))
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, ptr::null_mut(), make) }
}

/// # Safety
/// `camera.model` is null or ends in a zero byte.
unsafe fn rig_camera(camera: &VidarCamera) -> Result<RigCamera, Error> {
    // SAFETY: the caller's promise.
    let model = unsafe { text("the camera's model", camera.model) }?.parse::<CameraFlag>()?.0;
    let [x, y, z, w] = camera.body_from_camera_xyzw;
    let rotation =
        So3::from_quaternion(x, y, z, w).ok_or_else(|| usage("the camera's quaternion is zero"))?;
    Ok(RigCamera {
        model: with_size(&model, camera.width as usize, camera.height as usize)?,
        body_from_camera: Se3::new(rotation, camera.position_in_body.into()),
        time_offset: Duration::from_secs_f64(camera.time_offset_secs),
        rate_hz: None,
    })
}

fn noise(imu: &VidarImuNoise) -> ImuNoise {
    ImuNoise {
        gyro_noise_density: imu.gyro_noise_density,
        gyro_random_walk: imu.gyro_random_walk,
        accel_noise_density: imu.accel_noise_density,
        accel_random_walk: imu.accel_random_walk,
        rate_hz: imu.rate_hz,
    }
}

/// Takes an IMU sample: rad/s and m/s^2 in the IMU's axes, as measured. Returns 1 if `state` (which may be null) was written: that
/// after the oldest image that waited for it; 0 if none was; -1 on an error.
///
/// # Safety
/// `odometry` was made by vidar_odometry_new; `gyro` and `accel` are three numbers; others are null or may be written to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_odometry_push_imu(
    odometry: *mut VidarOdometry,
    time_ns: i64,
    gyro: *const f64,
    accel: *const f64,
    state: *mut VidarState,
    error: *mut *mut VidarError,
) -> i32 {
    // SAFETY: the caller's promise.
    let push = || unsafe {
        let vector =
            |v: *const f64| v.cast::<[f64; 3]>().as_ref().copied().ok_or_else(|| usage("a vector is null"));
        let sample = ImuSample {
            time: Timestamp::from_nanos(time_ns),
            gyro: AngularRate(vector(gyro)?.into()),
            accel: SpecificForce(vector(accel)?.into()),
        };
        push(odometry, SensorEvent::Imu(sample), state)
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, FAILED, push) }
}

/// Takes a grey image with its number and time (middle of the exposure, nanoseconds). Events come in the order of time; at equal times
/// the IMU comes first. Returns as vidar_odometry_push_imu.
///
/// # Safety
/// As vidar_odometry_push_imu; `image` points to an image whose pixels are there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_odometry_push_image(
    odometry: *mut VidarOdometry,
    frame: u32,
    time_ns: i64,
    image: *const VidarImage,
    state: *mut VidarState,
    error: *mut *mut VidarError,
) -> i32 {
    // SAFETY: the caller's promise.
    let push = || unsafe {
        let image = image.as_ref().ok_or_else(|| usage("image is null"))?.gray()?;
        let time = Timestamp::from_nanos(time_ns);
        let (id, camera, image) = (FrameId(frame), CameraId(0), FrameImage::Gray8(image));
        push(odometry, SensorEvent::Image(Frame { id, time, camera, image }), state)
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, FAILED, push) }
}

/// # Safety
/// As vidar_odometry_push_imu.
unsafe fn push(
    odometry: *mut VidarOdometry,
    event: SensorEvent,
    state: *mut VidarState,
) -> Result<i32, Error> {
    // SAFETY: the caller's promise.
    let odometry = unsafe { odometry.as_mut() }.ok_or_else(|| usage("odometry is null"))?;
    let output = odometry.machine.push(event)?;
    // SAFETY: the caller's promise.
    Ok(unsafe { give(output.as_ref(), state) })
}

/// After the last event: works on the images that still wait. Call it until it returns 0; 1 and -1 are as in
/// vidar_odometry_push_imu.
///
/// # Safety
/// As vidar_odometry_push_imu.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_odometry_finish(
    odometry: *mut VidarOdometry,
    state: *mut VidarState,
    error: *mut *mut VidarError,
) -> i32 {
    // SAFETY: the caller's promise.
    let finish = || unsafe {
        let odometry = odometry.as_mut().ok_or_else(|| usage("odometry is null"))?;
        let rest = odometry.rest.get_or_insert_with(|| odometry.machine.finish().into());
        let output = rest.pop_front();
        Ok(give(output.as_ref(), state))
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, FAILED, finish) }
}

/// # Safety
/// `state` is null or may be written to.
unsafe fn give(output: Option<&OdometryOutput>, state: *mut VidarState) -> i32 {
    let Some(output) = output else { return NO_STATE };
    if !state.is_null() {
        // SAFETY: the caller's promise.
        unsafe { state.write(state_of(output)) };
    }
    STATE
}

fn state_of(output: &OdometryOutput) -> VidarState {
    let health = output.health();
    let mut state = VidarState {
        time_ns: output.time.nanos(),
        frame: output.frame_id.0,
        segment: 0,
        is_tracking: false,
        is_metric: health.is_metric(),
        health: health_of(health),
        position_in_world: [0.0; 3],
        world_from_body_xyzw: [0.0; 4],
        velocity_in_world: [0.0; 3],
        gyro_bias: [0.0; 3],
        accel_bias: [0.0; 3],
        covariance: [0.0; 225],
        scale_std: 0.0,
    };
    if let Some(tracking) = output.tracking() {
        let nav = &tracking.state;
        state.is_tracking = true;
        state.segment = tracking.segment;
        state.position_in_world = nav.world_from_body.translation.into();
        state.world_from_body_xyzw = nav.world_from_body.rotation.quaternion_xyzw();
        state.velocity_in_world = nav.velocity_in_world.into();
        state.gyro_bias = nav.gyro_bias.into();
        state.accel_bias = nav.accel_bias.into();
        // Symmetric: rows are columns.
        state.covariance.copy_from_slice(tracking.covariance.as_slice());
        state.scale_std = tracking.scale_std;
    }
    state
}

fn health_of(health: Health) -> VidarHealth {
    match health {
        Health::Ok => VidarHealth::Ok,
        Health::ScaleConverging => VidarHealth::ScaleConverging,
        Health::ScaleUnknown => VidarHealth::ScaleUnknown,
        Health::LowFeatures => VidarHealth::LowFeatures,
        Health::Degraded => VidarHealth::Degraded,
        Health::Suspect => VidarHealth::Suspect,
        Health::Lost => VidarHealth::Lost,
    }
}

/// Frees an odometry; null is allowed.
///
/// # Safety
/// `odometry` is null or was made by vidar_odometry_new and is not freed yet.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_odometry_free(odometry: *mut VidarOdometry) {
    if !odometry.is_null() {
        // SAFETY: the caller's promise.
        drop(unsafe { Box::from_raw(odometry) });
    }
}
