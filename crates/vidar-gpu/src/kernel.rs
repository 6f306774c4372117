//! A kernel: shader text put together for its constants, and what it binds.

use std::sync::OnceLock;

/// Bytes of immediate data that every operation may use; every interface has at least as many.
pub(crate) const IMMEDIATES: u32 = 64;

/// Most buffers of one kind that a kernel binds.
const MOST_READS: usize = 6;

/// A shader with its constants filled in.
pub(crate) struct Kernel {
    /// Says which shader and constants; equal names are equal kernels.
    pub name: String,
    /// Buffers that are read only, bindings 0 and on.
    pub reads: usize,
    text: Box<dyn Fn() -> String + Send + Sync>,
}

impl Kernel {
    /// A kernel that reads `reads` buffers and writes one, which is bound last.
    pub fn new(name: String, reads: usize, text: impl Fn() -> String + Send + Sync + 'static) -> Self {
        assert!(reads <= MOST_READS, "{name}: {reads} buffers");
        Self { name, reads, text: Box::new(text) }
    }

    /// The WGSL.
    pub fn source(&self) -> String {
        (self.text)()
    }
}

/// Binding layouts by number of buffers read.
pub(crate) struct Layouts {
    groups: Vec<wgpu::BindGroupLayout>,
    pipelines: [OnceLock<wgpu::PipelineLayout>; MOST_READS + 1],
}

impl Layouts {
    pub fn new(device: &wgpu::Device) -> Self {
        let one = |reads: usize| {
            let entry = |binding: usize| wgpu::BindGroupLayoutEntry {
                binding: binding as u32,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: wgpu::BufferBindingType::Storage { read_only: binding < reads },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            };
            let entries: Vec<_> = (0..=reads).map(entry).collect();
            device
                .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries })
        };
        Self { groups: (0..=MOST_READS).map(one).collect(), pipelines: Default::default() }
    }

    pub fn group(&self, reads: usize) -> &wgpu::BindGroupLayout {
        &self.groups[reads]
    }

    pub fn pipeline(&self, device: &wgpu::Device, kernel: &Kernel) -> &wgpu::PipelineLayout {
        self.pipelines[kernel.reads].get_or_init(|| {
            device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: None,
                bind_group_layouts: &[Some(self.group(kernel.reads))],
                immediate_size: IMMEDIATES,
            })
        })
    }
}

/// Fills `{{key}}` places of a shader's text.
pub(crate) fn fill(template: &str, values: &[(&str, String)]) -> String {
    values
        .iter()
        .fold(template.to_owned(), |text, (key, value)| text.replace(&format!("{{{{{key}}}}}"), value))
}
