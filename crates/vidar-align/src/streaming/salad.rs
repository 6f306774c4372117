//! SALAD's aggregation: patch tokens of an image into one descriptor by optimal transport (Izquierdo and Civera 2024).
//!
//! Features f (l × n) and scores (m × n) come from the patch tokens through two small networks, a global vector g from the
//! class token through a third. A dustbin row of one learned value joins the scores; three Sinkhorn rounds in the log
//! domain spread the tokens over the clusters; `V = f Pᵀ` without the dustbin, each column of unit length, joins g.

use super::StreamingError;

/// Two linear layers with a rectifier between, applied to each column.
#[derive(Clone, Debug, PartialEq)]
pub struct Perceptron {
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
    fn apply(&self, inputs: &[f64], n: usize, what: &'static str) -> Result<Vec<f64>, StreamingError> {
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
) -> Result<Vec<f64>, StreamingError> {
    let width = inputs.len().checked_div(n).unwrap_or(0);
    let expected = width * bias.len();
    if weight.len() != expected || inputs.len() != width * n {
        return Err(StreamingError::WrongLength { what, found: weight.len(), expected });
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
pub struct SaladHead {
    /// `cluster_features`: tokens to features.
    pub cluster_features: Perceptron,
    /// `score`: tokens to cluster scores.
    pub score: Perceptron,
    /// `token_features`: class token to the global vector.
    pub token_features: Perceptron,
    /// `dust_bin`: score of belonging to no cluster.
    pub dust_bin: f32,
}

const SINKHORN_ROUNDS: usize = 3;

impl SaladHead {
    /// The unit-length descriptor of one image: global vector, then clusters, row-major (feature, cluster).
    ///
    /// `patches` is row-major `[channels, tokens]`, `class_token` `[channels]`.
    ///
    /// # Errors
    /// [`StreamingError::WrongLength`] naming the layer whose size does not fit.
    pub fn describe(
        &self,
        patches: &[f32],
        tokens: usize,
        class_token: &[f32],
    ) -> Result<Vec<f32>, StreamingError> {
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
        let patches = wide(patches);
        let features = self.cluster_features.apply(&patches, tokens, "weights of cluster_features")?;
        let scores = self.score.apply(&patches, tokens, "weights of score")?;
        let global = self.token_features.apply(&wide(class_token), 1, "weights of token_features")?;
        let clusters = self.score.second_bias.len();
        if tokens <= clusters {
            return Err(StreamingError::WrongLength {
                what: "patch tokens",
                found: tokens,
                expected: clusters + 1,
            });
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

/// How much of each token goes to each cluster, row-major `[clusters, tokens]`; the dustbin takes the rest.
fn transport(scores: &[f64], clusters: usize, tokens: usize, dust_bin: f64) -> Vec<f64> {
    let mut matrix = scores.to_vec();
    matrix.resize((clusters + 1) * tokens, dust_bin);
    let share = -((tokens + clusters) as f64).ln();
    let row_mass =
        |row: usize| if row < clusters { share } else { share + ((tokens - clusters) as f64).ln() };
    let (mut u, mut v) = (vec![0.0; clusters + 1], vec![0.0; tokens]);
    for _ in 0..SINKHORN_ROUNDS {
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
    fn a_descriptor_has_unit_length_and_does_not_care_for_the_order_of_tokens() {
        let head = SaladHead {
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
    fn weights_of_another_size_are_named() {
        let head = SaladHead {
            cluster_features: perceptron(6, 9, 4),
            score: perceptron(5, 9, 3),
            token_features: perceptron(6, 9, 5),
            dust_bin: 0.7,
        };
        let error = head.describe(&[0.0; 66], 11, &[0.0; 6]).unwrap_err();
        assert!(error.to_string().starts_with("weights of score"), "{error}");
    }
}
