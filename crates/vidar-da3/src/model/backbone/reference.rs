//! The reference view, in whose camera frame an any-view network predicts (DA3, reference view selection).
//!
//! With three views or more and no poses given, it is chosen from the class tokens before the alternation begins. For
//! token c of each view: its mean cosine with the others, its norm, and the variance of its normalised channels, each
//! scaled to 0…1 over the views; the view nearest the middle of all three is the reference.

use serde::{Deserialize, Serialize};

/// How the reference view is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReferenceStrategy {
    /// The view in the middle of similarity, norm and variance.
    #[default]
    SaddleBalanced,
    /// The view with the widest range of similarities. The two most similar views tie exactly, so that rounding
    /// decides between them.
    SaddleSimRange,
    /// The first view.
    First,
    /// View `n/2`.
    Middle,
    /// A view by its index.
    View(usize),
}

/// Fewer views than this keep their order.
pub(crate) const MIN_VIEWS: usize = 3;

/// The reference among views with the given class tokens.
pub fn choose(tokens: &[&[f32]], strategy: ReferenceStrategy) -> usize {
    let views = tokens.len();
    match strategy {
        _ if views < MIN_VIEWS => 0,
        ReferenceStrategy::First => 0,
        ReferenceStrategy::View(view) => view.min(views - 1),
        ReferenceStrategy::Middle => views / 2,
        ReferenceStrategy::SaddleBalanced => balanced(tokens),
        ReferenceStrategy::SaddleSimRange => {
            let similarity = similarities(tokens);
            let range = |row: &Vec<f64>| {
                let most = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                most - row.iter().copied().fold(f64::INFINITY, f64::min)
            };
            let ranges: Vec<f64> = similarity.iter().map(range).collect();
            (0..views).fold(0, |best, v| if ranges[v] > ranges[best] { v } else { best })
        }
    }
}

/// Cosines between views, less one on the diagonal.
fn similarities(tokens: &[&[f32]]) -> Vec<Vec<f64>> {
    let directions: Vec<Vec<f64>> = tokens.iter().map(|t| direction(t)).collect();
    let cosine = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    (0..tokens.len())
        .map(|v| {
            let one = |j: usize| cosine(&directions[v], &directions[j]) - if v == j { 1.0 } else { 0.0 };
            (0..tokens.len()).map(one).collect()
        })
        .collect()
}

fn norm(token: &[f32]) -> f64 {
    token.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt()
}

fn direction(token: &[f32]) -> Vec<f64> {
    let norm = norm(token);
    token.iter().map(|x| f64::from(*x) / norm).collect()
}

fn balanced(tokens: &[&[f32]]) -> usize {
    let others = (tokens.len() - 1) as f64;
    let mean_similarity: Vec<f64> =
        similarities(tokens).iter().map(|row| row.iter().sum::<f64>() / others).collect();
    let norms: Vec<f64> = tokens.iter().map(|t| norm(t)).collect();
    let variance = |token: &&[f32]| {
        let d = direction(token);
        let mean = d.iter().sum::<f64>() / d.len() as f64;
        d.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (d.len() - 1) as f64
    };
    let variances: Vec<f64> = tokens.iter().map(variance).collect();
    let scores = [mean_similarity, norms, variances].map(from_zero_to_one);
    let distance = |v: usize| scores.iter().map(|s| (s[v] - 0.5).abs()).sum::<f64>();
    (0..tokens.len()).fold(0, |best, v| if distance(v) < distance(best) { v } else { best })
}

fn from_zero_to_one(values: Vec<f64>) -> Vec<f64> {
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    values.iter().map(|v| (v - least) / (most - least + 1e-8)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_view_in_the_middle_of_everything_is_chosen() {
        // Norms 1, 2, 3; directions turn away one after the other: the second is in the middle.
        let tokens: [&[f32]; 3] = [&[1.0, 0.0, 0.0], &[1.9, 0.6, 0.0], &[2.4, 1.8, 0.1]];
        assert_eq!(choose(&tokens, ReferenceStrategy::SaddleBalanced), 1);
        assert_eq!(choose(&tokens, ReferenceStrategy::First), 0);
        assert_eq!(choose(&tokens, ReferenceStrategy::Middle), 1);
        assert_eq!(choose(&tokens[..2], ReferenceStrategy::Middle), 0, "two views keep their order");
    }
}
