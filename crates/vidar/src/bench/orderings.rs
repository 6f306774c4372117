//! Checks which orderings of the paper's results hold in a bench.

use super::BenchRow;
use super::tables::{Grid, Table, mean};
use vidar_align::CouplingMode;

/// Scores this close count as equal.
const EQUAL_SCORES: f64 = 0.005;
/// If the scale of ground truth improves F@0.10 by more than this, the map was not metric. The paper's pose-free column gains 0.256,
/// its pose-conditioned one 0.018.
const METRIC_GAIN: f64 = 0.05;

impl Table<'_> {
    /// The claims that can be checked with the couplings that were run; `None` with fewer than two couplings.
    pub(super) fn orderings(&self) -> Option<Grid> {
        use CouplingMode::{Coupled, GroundTruth, Hybrid, PoseConditioned, PoseFree};
        let claims = [
            self.gains("pose-free loses the metric scale", PoseFree, true),
            self.gains("pose-conditioned is metric", PoseConditioned, false),
            self.beats("pose-conditioned beats pose-free", PoseConditioned, PoseFree),
            self.beats(
                "true poses are at least as good as those of the odometry",
                GroundTruth,
                PoseConditioned,
            ),
            self.beats("hybrid beats pose-conditioned", Hybrid, PoseConditioned),
            self.beats("coupled beats pose-conditioned (ours)", Coupled, PoseConditioned),
            self.beats("coupled beats hybrid (ours)", Coupled, Hybrid),
        ];
        let rows: Vec<Vec<String>> = claims.into_iter().flatten().collect();
        (self.request.modes.len() > 1 && !rows.is_empty()).then(|| Grid {
            caption: "Claims of the paper, and whether they hold here (F@0.10 with the scale refined, as the paper has it; a failed run counts as 0)"
                .into(),
            columns: ["Claim", "Holds", "On average", "Sequences"].map(String::from).to_vec(),
            rows,
        })
    }

    /// One coupling against another, sequence by sequence.
    fn beats(&self, claim: &str, better: CouplingMode, worse: CouplingMode) -> Option<Vec<String>> {
        if !(self.request.modes.contains(&better) && self.request.modes.contains(&worse)) {
            return None;
        }
        let score = |r: &BenchRow| r.f10.unwrap_or(0.0);
        let pairs: Vec<(f64, f64)> = self
            .sequences
            .iter()
            .filter_map(|s| Some((score(self.of(s, better)?), score(self.of(s, worse)?))))
            .collect();
        let (a, b): (Vec<f64>, Vec<f64>) = pairs.iter().copied().unzip();
        let (a, b) = (mean(&a)?, mean(&b)?);
        let wins = pairs.iter().filter(|(a, b)| *a >= b - EQUAL_SCORES).count();
        let holds = if a > b + EQUAL_SCORES {
            "yes"
        } else if a >= b - EQUAL_SCORES {
            "tie"
        } else {
            "no"
        };
        Some(cells(claim, holds, format!("{a:.3} and {b:.3}"), wins, pairs.len()))
    }

    /// Gain of F@0.10 with the scale of ground truth over the rigid fit, which keeps the map's own.
    fn gains(&self, claim: &str, mode: CouplingMode, should: bool) -> Option<Vec<String>> {
        let gains: Vec<f64> = self
            .sequences
            .iter()
            .filter_map(|s| self.of(s, mode))
            .filter_map(|r| Some(r.f10_free? - r.f10_rigid?))
            .collect();
        let gain = mean(&gains)?;
        let as_claimed = gains.iter().filter(|g| (**g > METRIC_GAIN) == should).count();
        let holds = if (gain > METRIC_GAIN) == should { "yes" } else { "no" };
        Some(cells(
            claim,
            holds,
            format!("the scale of ground truth gains {gain:.3}"),
            as_claimed,
            gains.len(),
        ))
    }
}

fn cells(claim: &str, holds: &str, numbers: String, count: usize, of: usize) -> Vec<String> {
    vec![claim.to_owned(), holds.to_owned(), numbers, format!("{count} of {of}")]
}

#[cfg(test)]
mod tests {
    use super::super::tables::tests::request;
    use super::*;

    fn row(sequence: &str, mode: CouplingMode, f10: Option<f64>, free: Option<f64>) -> BenchRow {
        BenchRow {
            sequence: sequence.into(),
            mode,
            f10,
            f10_rigid: f10,
            f10_free: free,
            ..BenchRow::default()
        }
    }

    #[test]
    fn claims_follow_the_numbers_and_failures_count_as_zero() {
        use CouplingMode::{Coupled, PoseConditioned, PoseFree};
        let modes = [PoseFree, PoseConditioned, Coupled];
        let names = ["V1_01".to_owned(), "V1_02".to_owned()];
        let rows = [
            row("V1_01", PoseFree, Some(0.1), Some(0.5)),
            row("V1_02", PoseFree, None, None),
            row("V1_01", PoseConditioned, Some(0.5), Some(0.52)),
            row("V1_02", PoseConditioned, Some(0.6), Some(0.6)),
            row("V1_01", Coupled, Some(0.4), Some(0.4)),
            row("V1_02", Coupled, Some(0.6), Some(0.6)),
        ];
        let claims_of = |modes: &[CouplingMode], rows: &[BenchRow]| {
            let request = &request(modes.to_vec());
            Table { request, sequences: &names, rows, odometry: &[] }.orderings()
        };
        let grid = claims_of(&modes, &rows).unwrap();
        let claims: Vec<[&str; 4]> =
            grid.rows.iter().map(|r| [&r[0], &r[1], &r[2], &r[3]].map(String::as_str)).collect();
        assert_eq!(
            claims[0],
            ["pose-free loses the metric scale", "yes", "the scale of ground truth gains 0.400", "1 of 1"]
        );
        assert_eq!(claims[1][1..], ["yes", "the scale of ground truth gains 0.010", "2 of 2"]);
        assert_eq!(claims[2][1..], ["yes", "0.550 and 0.050", "2 of 2"]);
        assert_eq!(claims[3][1..], ["no", "0.500 and 0.550", "1 of 2"]);
        assert_eq!(claims.len(), 4, "no claim about couplings that were not run");
        assert!(claims_of(&modes[..1], &rows[..2]).is_none());
    }
}
