//! A feature map that owns its numbers.

use vidar_nn::{Compute, Conv2d, ConvInput, Corners, Epilogue, MapRef, resize_bilinear};

/// `[rows, columns, channels]` of one view.
#[derive(Clone, Debug)]
pub(crate) struct Map {
    pub data: Vec<f32>,
    pub rows: usize,
    pub columns: usize,
    pub channels: usize,
}

impl Map {
    pub fn zeros(rows: usize, columns: usize, channels: usize) -> Self {
        Self { data: vec![0.0; rows * columns * channels], rows, columns, channels }
    }

    pub fn view(&self) -> MapRef<'_> {
        MapRef::new(&self.data, self.rows, self.columns)
    }

    pub fn shape(&self) -> [usize; 3] {
        [self.rows, self.columns, self.channels]
    }

    /// This map convolved, in a new one.
    pub fn convolved(&self, c: &Compute, conv: &Conv2d, input: ConvInput, end: Epilogue<'_>) -> Self {
        let (rows, columns) = conv.output_size(self.rows, self.columns);
        let mut out = Self::zeros(rows, columns, conv.out_channels());
        conv.apply(c, self.view(), &mut out.data, input, end);
        out
    }

    /// This map enlarged (or shrunk) with the corner pixels' centres kept.
    pub fn resized(&self, rows: usize, columns: usize) -> Self {
        let mut out = Self::zeros(rows, columns, self.channels);
        resize_bilinear(self.view(), self.channels, rows, columns, Corners::Aligned, &mut out.data);
        out
    }
}
