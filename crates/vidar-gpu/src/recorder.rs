//! Operations recorded and submitted together.

use crate::buffer::Buffer;
use crate::device::Gpu;
use crate::error::GpuError;
use crate::kernel::{IMMEDIATES, Kernel};
use std::sync::mpsc;
use std::time::Duration;

/// Submissions that may be under way before the next one waits.
const IN_FLIGHT: usize = 2;
/// Until memory that the device is done with must be mapped: another thread that waits for the device can have taken the message
/// and not yet passed it on.
const MAPPED_WITHIN: Duration = Duration::from_secs(10);

/// Takes operations in order; [`Recorder::submit`] sends them off. Few submissions are under way at a time, so that a run
/// can be stopped between them.
pub struct Recorder {
    gpu: Gpu,
    encoder: Option<wgpu::CommandEncoder>,
    pass: Option<wgpu::ComputePass<'static>>,
    under_way: Vec<wgpu::SubmissionIndex>,
}

impl Recorder {
    /// An empty recorder.
    pub fn new(gpu: &Gpu) -> Self {
        Self { gpu: gpu.clone(), encoder: None, pass: None, under_way: Vec::new() }
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    fn encoder(&mut self) -> &mut wgpu::CommandEncoder {
        self.pass = None;
        let device = &self.gpu.shared.device;
        self.encoder.get_or_insert_with(|| device.create_command_encoder(&Default::default()))
    }

    /// Records a kernel over `groups` workgroups; `words` are its immediate data.
    pub(crate) fn dispatch(
        &mut self,
        kernel: &Kernel,
        reads: &[&Buffer],
        out: &Buffer,
        words: &[u32],
        groups: [u32; 3],
    ) -> Result<(), GpuError> {
        debug_assert_eq!(reads.len(), kernel.reads, "{}", kernel.name);
        assert!(words.len() * 4 <= IMMEDIATES as usize, "{}: immediate data", kernel.name);
        if groups.contains(&0) {
            return Ok(());
        }
        let pipeline = self.gpu.pipeline(kernel)?;
        let shared = &self.gpu.shared;
        let bound = reads.iter().copied().chain(std::iter::once(out)).enumerate();
        let entries: Vec<_> = bound
            .map(|(binding, buffer)| wgpu::BindGroupEntry {
                binding: binding as u32,
                resource: buffer.raw.as_entire_binding(),
            })
            .collect();
        let group = shared.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(&kernel.name),
            layout: shared.layouts.group(kernel.reads),
            entries: &entries,
        });
        if self.pass.is_none() {
            let pass = self.encoder().begin_compute_pass(&Default::default()).forget_lifetime();
            self.pass = Some(pass);
        }
        let Some(pass) = &mut self.pass else { return Ok(()) };
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        // All of it is set: what a kernel does not declare must still be there.
        let mut all = [0u32; IMMEDIATES as usize / 4];
        all[..words.len()].copy_from_slice(words);
        pass.set_immediates(0, bytemuck::cast_slice(&all));
        pass.dispatch_workgroups(groups[0], groups[1], groups[2]);
        Ok(())
    }

    /// Copies `len` numbers between buffers.
    ///
    /// # Panics
    /// When a range does not fit.
    pub fn copy(&mut self, from: (&Buffer, usize), to: (&Buffer, usize), len: usize) {
        assert!(from.1 + len <= from.0.len() && to.1 + len <= to.0.len(), "copy of {len} numbers");
        if len > 0 {
            let bytes = |n: usize| n as u64 * 4;
            let size = bytes(len);
            self.encoder().copy_buffer_to_buffer(&from.0.raw, bytes(from.1), &to.0.raw, bytes(to.1), size);
        }
    }

    /// Sends off what was recorded.
    ///
    /// # Errors
    /// What the device said up to now, see [`Gpu::check`].
    pub fn submit(&mut self) -> Result<(), GpuError> {
        self.pass = None;
        if let Some(encoder) = self.encoder.take() {
            let submission = self.gpu.shared.queue.submit([encoder.finish()]);
            self.under_way.push(submission);
            if self.under_way.len() > IN_FLIGHT {
                let oldest = self.under_way.remove(0);
                self.gpu.wait_for(oldest)?;
            }
        }
        self.gpu.check()
    }

    /// Sends off what was recorded, waits, and reads numbers back.
    ///
    /// # Errors
    /// As [`Recorder::submit`].
    ///
    /// # Panics
    /// When the range does not fit.
    pub fn read(&mut self, from: &Buffer, at: usize, len: usize) -> Result<Vec<f32>, GpuError> {
        assert!(at + len <= from.len(), "read of {len} numbers at {at} of {}", from.len());
        if len == 0 {
            return self.submit().map(|()| Vec::new());
        }
        let size = len as u64 * 4;
        let staging = self.gpu.shared.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("reading back"),
            size,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.encoder().copy_buffer_to_buffer(&from.raw, at as u64 * 4, &staging, 0, size);
        self.submit()?;
        let (tell, told) = mpsc::sync_channel(1);
        staging.slice(..).map_async(wgpu::MapMode::Read, move |result| {
            let _ = tell.send(result.map_err(|error| error.to_string()));
        });
        self.gpu.wait()?;
        self.under_way.clear();
        match told.recv_timeout(MAPPED_WITHIN) {
            Ok(Ok(())) => {}
            Ok(Err(reason)) => return Err(self.gpu.refused(reason)),
            Err(_) => return Err(self.gpu.refused("memory was not mapped".to_owned())),
        }
        let range = staging.slice(..).get_mapped_range().map_err(|e| self.gpu.refused(e.to_string()))?;
        let mut values = vec![0.0; len];
        bytemuck::cast_slice_mut(&mut values).copy_from_slice(&range);
        Ok(values)
    }
}
