//! SALAD's aggregation: the patch tokens of an image become one descriptor by optimal transport (Izquierdo and Civera 2024).
//!
//! Two perceptrons compute features f (l × n) and cluster scores (m × n) from the n patch tokens; a third computes a global
//! vector g from the class token. A dustbin row, one learned value, is appended to the scores. Three Sinkhorn iterations in
//! the log domain give the assignment P of tokens to clusters. The descriptor is g followed by `V = f Pᵀ` without the
//! dustbin, each column of V and the whole normalised to unit length.

use crate::error::Da3Error;

/// Two linear layers with a ReLU between them, applied to each column.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Perceptron {
    /// First layer, row-major `[hidden, input]`.
    pub first: Vec<f32>,
    /// Its bias `[hidden]`.
    pub first_bias: Vec<f32>,
    /// Second layer, row-major `[output, hidden]`.
    pub second: Vec<f32>,
    /// Its bias `[output]`.
    pub second_bias: Vec<f32>,
}

impl Perceptron {
    /// Output for `inputs` of n columns, row-major `[input, n]`.
    fn apply(&self, inputs: &[f64], n: usize, what: &'static str) -> Result<Vec<f64>, Da3Error> {
        let hidden = dense(&self.first, &self.first_bias, inputs, n, what)?;
        let hidden: Vec<f64> = hidden.into_iter().map(|v| v.max(0.0)).collect();
        dense(&self.second, &self.second_bias, &hidden, n, what)
    }
}

fn dense(
    weight: &[f32],
    bias: &[f32],
    inputs: &[f64],
    n: usize,
    what: &'static str,
) -> Result<Vec<f64>, Da3Error> {
    let width = inputs.len().checked_div(n).unwrap_or(0);
    let expected = width * bias.len();
    if weight.len() != expected || inputs.len() != width * n {
        let reason = format!("{} values, expected {expected}", weight.len());
        return Err(Da3Error::BadInput { what, reason });
    }
    let mut out = Vec::with_capacity(bias.len() * n);
    for (row, b) in weight.chunks_exact(width.max(1)).zip(bias) {
        let start = out.len();
        out.resize(start + n, f64::from(*b));
        for (w, input) in row.iter().zip(inputs.chunks_exact(n.max(1))) {
            for (o, x) in out[start..].iter_mut().zip(input) {
                *o += f64::from(*w) * x;
            }
        }
    }
    Ok(out)
}

/// The weights of the aggregation.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Aggregation {
    /// `cluster_features`: tokens to features.
    pub cluster_features: Perceptron,
    /// `score`: tokens to cluster scores.
    pub score: Perceptron,
    /// `token_features`: class token to the global vector.
    pub token_features: Perceptron,
    /// `dust_bin`: score of belonging to no cluster.
    pub dust_bin: f32,
}

const SINKHORN_ITERATIONS: usize = 3;

impl Aggregation {
    /// The unit-length descriptor of one image, `[g, V]` with V row-major `[features, clusters]`.
    ///
    /// `patches` is row-major `[channels, tokens]`, `class_token` is `[channels]`.
    ///
    /// # Errors
    /// [`Da3Error::BadInput`] with the name of the layer whose size does not fit, or when there are no more tokens than
    /// clusters.
    pub fn describe(
        &self,
        patches: &[f32],
        tokens: usize,
        class_token: &[f32],
    ) -> Result<Vec<f32>, Da3Error> {
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
        let patches = wide(patches);
        let features = self.cluster_features.apply(&patches, tokens, "weights of cluster_features")?;
        let scores = self.score.apply(&patches, tokens, "weights of score")?;
        let global = self.token_features.apply(&wide(class_token), 1, "weights of token_features")?;
        let clusters = self.score.second_bias.len();
        if tokens <= clusters {
            let reason = format!("{tokens} tokens, expected at least {}", clusters + 1);
            return Err(Da3Error::BadInput { what: "patch tokens", reason });
        }
        let assignment = transport(&scores, clusters, tokens, f64::from(self.dust_bin));
        let mut aggregated = vec![0.0; self.cluster_features.second_bias.len() * clusters];
        for (row, out) in features.chunks_exact(tokens).zip(aggregated.chunks_exact_mut(clusters)) {
            for (weights, value) in assignment.chunks_exact(tokens).zip(out) {
                *value = row.iter().zip(weights).map(|(f, p)| f * p).sum();
            }
        }
        for k in 0..clusters {
            let column = || (k..aggregated.len()).step_by(clusters);
            let length = column().map(|i| aggregated[i] * aggregated[i]).sum::<f64>().sqrt().max(1e-12);
            let indices: Vec<usize> = column().collect();
            indices.into_iter().for_each(|i| aggregated[i] /= length);
        }
        let mut descriptor = unit(global);
        descriptor.extend(aggregated);
        Ok(unit(descriptor).into_iter().map(|v| v as f32).collect())
    }
}

/// The assignment of tokens to clusters, row-major `[clusters, tokens]`; the rest of each token is in the dustbin.
fn transport(scores: &[f64], clusters: usize, tokens: usize, dust_bin: f64) -> Vec<f64> {
    let mut matrix = scores.to_vec();
    matrix.resize((clusters + 1) * tokens, dust_bin);
    let share = -((tokens + clusters) as f64).ln();
    let row_mass =
        |row: usize| if row < clusters { share } else { share + ((tokens - clusters) as f64).ln() };
    let (mut u, mut v) = (vec![0.0; clusters + 1], vec![0.0; tokens]);
    for _ in 0..SINKHORN_ITERATIONS {
        for (row, u) in u.iter_mut().enumerate() {
            let terms = matrix[row * tokens..(row + 1) * tokens].iter().zip(&v).map(|(m, v)| m + v);
            *u = row_mass(row) - log_sum_exp(terms);
        }
        for (column, v) in v.iter_mut().enumerate() {
            let terms = matrix[column..].iter().step_by(tokens).zip(&u).map(|(m, u)| m + u);
            *v = share - log_sum_exp(terms);
        }
    }
    (0..clusters * tokens).map(|i| (matrix[i] + u[i / tokens] + v[i % tokens] - share).exp()).collect()
}

fn log_sum_exp(terms: impl Iterator<Item = f64> + Clone) -> f64 {
    let largest = terms.clone().fold(f64::NEG_INFINITY, f64::max);
    largest + terms.map(|t| (t - largest).exp()).sum::<f64>().ln()
}

fn unit(mut values: Vec<f64>) -> Vec<f64> {
    let length = values.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    values.iter_mut().for_each(|v| *v /= length);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::testing::shared_data;
    use vidar_nn::Checkpoint;

    fn perceptron(input: usize, hidden: usize, output: usize) -> Perceptron {
        let wave = |n: usize, s: f32| (0..n).map(|i| (i as f32 * s).sin()).collect::<Vec<f32>>();
        Perceptron {
            first: wave(hidden * input, 1.7),
            first_bias: wave(hidden, 0.3),
            second: wave(output * hidden, 2.3),
            second_bias: wave(output, 0.9),
        }
    }

    #[test]
    fn a_descriptor_has_unit_length_and_is_invariant_to_the_order_of_tokens() {
        let head = Aggregation {
            cluster_features: perceptron(6, 9, 4),
            score: perceptron(6, 9, 3),
            token_features: perceptron(6, 9, 5),
            dust_bin: 0.7,
        };
        let (n, class) = (11, [0.1, -0.4, 0.3, 0.9, 0.2, -0.7]);
        let patches: Vec<f32> = (0..6 * n).map(|i| (i as f32 * 0.37).cos()).collect();
        let described = head.describe(&patches, n, &class).unwrap();
        assert_eq!(described.len(), 5 + 4 * 3);
        assert!((described.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
        let backwards: Vec<f32> = patches.chunks_exact(n).flat_map(|r| r.iter().rev().copied()).collect();
        let other = head.describe(&backwards, n, &class).unwrap();
        assert!(described.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn an_error_names_the_weights_of_wrong_size() {
        let head = Aggregation {
            cluster_features: perceptron(6, 9, 4),
            score: perceptron(5, 9, 3),
            token_features: perceptron(6, 9, 5),
            dust_bin: 0.7,
        };
        let error = head.describe(&[0.0; 66], 11, &[0.0; 6]).unwrap_err();
        assert!(error.to_string().starts_with("weights of score"), "{error}");
    }

    /// Recorded from the official code; the file is outside the repository.
    #[test]
    fn descriptors_match_the_official_code() {
        let Some(file) = shared_data("golden/streaming/salad_small.safetensors") else { return };
        let golden = Checkpoint::open(&file).unwrap();
        let values = |key: &str| golden.tensor(key).unwrap().to_f32().unwrap();
        let shape = |key: &str| golden.tensor(key).unwrap().shape.to_vec();
        let perceptron = |name: &str, second: usize| Perceptron {
            first: values(&format!("w.{name}.0.weight")),
            first_bias: values(&format!("w.{name}.0.bias")),
            second: values(&format!("w.{name}.{second}.weight")),
            second_bias: values(&format!("w.{name}.{second}.bias")),
        };
        let head = Aggregation {
            cluster_features: perceptron("cluster_features", 3),
            score: perceptron("score", 3),
            token_features: perceptron("token_features", 2),
            dust_bin: values("w.dust_bin")[0],
        };
        let (input, output) = (shape("in.features"), shape("out.descriptor"));
        let (channels, tokens) = (input[1], input[2] * input[3]);
        let (features, class) = (values("in.features"), values("in.token"));
        let expected = values("out.descriptor");
        for image in 0..input[0] {
            let patches = &features[image * channels * tokens..(image + 1) * channels * tokens];
            let class_token = &class[image * channels..(image + 1) * channels];
            let found = head.describe(patches, tokens, class_token).unwrap();
            assert_eq!(found.len(), output[1]);
            for (a, b) in found.iter().zip(&expected[image * output[1]..]) {
                assert!((a - b).abs() < 1e-6, "{image}: {a} {b}");
            }
        }
    }
}
