//! What `--debug-dump` writes, for plots: tracks with residuals, and states, one line each.

use crate::error::Error;
use crate::run_folder::RunFolder;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use vidar_odometry::{OdometryOutput, TrackRecord};

/// Files inside the run folder.
pub(super) const TRACKS: &str = "odometry/debug_tracks.csv";
pub(super) const STATES: &str = "odometry/debug_states.csv";

const TRACKS_HEAD: &str = "#time_ns,frame,track,level,is_landmark,u_px,v_px,residual_u_px,residual_v_px,\
    inverse_distance_per_m,inverse_distance_std_per_m";
const STATES_HEAD: &str = "#time_ns,frame,segment,px_m,py_m,pz_m,qx,qy,qz,qw,vx_mps,vy_mps,vz_mps,\
    bgx,bgy,bgz,bax,bay,baz,std_rx_rad,std_ry_rad,std_rz_rad,std_px_m,std_py_m,std_pz_m,std_vx_mps,std_vy_mps,\
    std_vz_mps,std_bgx,std_bgy,std_bgz,std_bax,std_bay,std_baz,scale_std,chi2_per_dof,contradicting";

/// Both files while they grow.
pub(crate) struct Dump {
    tracks: (PathBuf, BufWriter<File>),
    states: (PathBuf, BufWriter<File>),
}

/// An empty file but for its head.
fn begin(path: &Path, name: &str) -> Result<BufWriter<File>, Error> {
    let failed = |e| Error::io("write", path, e);
    let mut writer = BufWriter::new(File::create(path).map_err(failed)?);
    let head = if name == TRACKS { TRACKS_HEAD } else { STATES_HEAD };
    writeln!(writer, "{head}").map_err(failed)?;
    Ok(writer)
}

impl Dump {
    /// Begins both files.
    pub(super) fn create(folder: &RunFolder) -> Result<Self, Error> {
        let file = |name: &str| folder.file(name).and_then(|path| Ok((begin(&path, name)?, path)));
        let [(tracks, of_tracks), (states, of_states)] = [file(TRACKS)?, file(STATES)?];
        Ok(Self { tracks: (of_tracks, tracks), states: (of_states, states) })
    }

    /// Begins a pass: what an earlier one wrote is dropped.
    pub(super) fn begin(&mut self) -> Result<(), Error> {
        self.tracks.1 = begin(&self.tracks.0, TRACKS)?;
        self.states.1 = begin(&self.states.0, STATES)?;
        Ok(())
    }

    /// Adds one image.
    pub(super) fn add(&mut self, output: &OdometryOutput, records: &[TrackRecord]) -> Result<(), Error> {
        let Some(tracking) = output.tracking() else { return Ok(()) };
        let head = (output.time.nanos(), output.frame_id);
        let (path, writer) = &mut self.tracks;
        let failed = |path: &PathBuf, e| Error::io("write", path, e);
        for r in records {
            let residual = r.residual.map_or_else(|| ",".into(), |v| format!("{:.4},{:.4}", v.x, v.y));
            writeln!(
                writer,
                "{},{},{},{},{},{:.3},{:.3},{residual},{:.6},{:.6}",
                head.0,
                head.1,
                r.id,
                r.level,
                u8::from(r.is_landmark),
                r.pixel.x,
                r.pixel.y,
                r.inverse_distance[0],
                r.inverse_distance[1],
            )
            .map_err(|e| failed(path, e))?;
        }
        let state = &tracking.state;
        let pose = &state.world_from_body;
        let mut values: Vec<f64> = Vec::with_capacity(40);
        values.extend(pose.translation.iter());
        values.extend(pose.rotation.quaternion_xyzw());
        values.extend(state.velocity_in_world.iter());
        values.extend(state.gyro_bias.iter());
        values.extend(state.accel_bias.iter());
        values.extend((0..15).map(|k| tracking.covariance[(k, k)].max(0.0).sqrt()));
        values.extend([tracking.scale_std, tracking.tracks.chi2_per_dof]);
        let (path, writer) = &mut self.states;
        let values: Vec<String> = values.iter().map(|v| format!("{v:.9}")).collect();
        writeln!(
            writer,
            "{},{},{},{},{}",
            head.0,
            head.1,
            tracking.segment,
            values.join(","),
            tracking.tracks.contradicting
        )
        .map_err(|e| failed(path, e))
    }

    /// Ends both files.
    pub(super) fn finish(self) -> Result<(), Error> {
        for (path, mut writer) in [self.tracks, self.states] {
            writer.flush().map_err(|e| Error::io("write", &path, e))?;
        }
        Ok(())
    }
}
