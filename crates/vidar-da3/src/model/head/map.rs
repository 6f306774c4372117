//! A feature map that owns its numbers.

use vidar_nn::{
    Compute, Conv2d, ConvInput, Corners, Epilogue, GridEmbedding, MapRef, MapSize, resize_bilinear,
};

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
    pub fn resized(&self, c: &Compute, rows: usize, columns: usize) -> Self {
        let mut out = Self::zeros(rows, columns, self.channels);
        let size = MapSize { rows, cols: columns };
        resize_bilinear(c, self.view(), self.channels, size, Corners::Aligned, &mut out.data);
        out
    }

    /// Adds an embedding of this map's size.
    pub fn embed(&mut self, embedding: &GridEmbedding) {
        let size = MapSize { rows: self.rows, cols: self.columns };
        embedding.add_to(&mut self.data, self.channels, size);
    }
}
