//! The largest set of loops that all agree with each other.

/// Beyond this many loops the exact search gives way to a greedy one.
const EXACT_UP_TO: usize = 64;

/// The largest clique of the graph "i and j agree", the first found among equals; ascending.
pub(super) fn largest(n: usize, agree: impl Fn(usize, usize) -> bool) -> Vec<usize> {
    let mut neighbours = vec![vec![false; n]; n];
    for i in 0..n {
        for j in 0..i {
            let yes = agree(i, j);
            neighbours[i][j] = yes;
            neighbours[j][i] = yes;
        }
    }
    if n <= EXACT_UP_TO {
        let mut search = Search { neighbours: &neighbours, best: Vec::new(), steps: 0 };
        search.extend(&mut Vec::new(), (0..n).collect());
        return search.best;
    }
    greedy(&neighbours)
}

struct Search<'a> {
    neighbours: &'a [Vec<bool>],
    best: Vec<usize>,
    steps: usize,
}

impl Search<'_> {
    /// Branch and bound; after a million steps the best so far stands (adversarial graphs only).
    fn extend(&mut self, chosen: &mut Vec<usize>, candidates: Vec<usize>) {
        if chosen.len() > self.best.len() {
            self.best.clone_from(chosen);
        }
        for (k, &next) in candidates.iter().enumerate() {
            self.steps += 1;
            if chosen.len() + candidates.len() - k <= self.best.len() || self.steps > 1_000_000 {
                return;
            }
            let rest = candidates[k + 1..].iter().copied().filter(|&c| self.neighbours[next][c]).collect();
            chosen.push(next);
            self.extend(chosen, rest);
            chosen.pop();
        }
    }
}

/// From the loop with most agreements on, whatever agrees with all taken so far.
fn greedy(neighbours: &[Vec<bool>]) -> Vec<usize> {
    let degree = |i: usize| neighbours[i].iter().filter(|b| **b).count();
    let mut order: Vec<usize> = (0..neighbours.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(degree(i)), i));
    let mut chosen: Vec<usize> = Vec::new();
    for i in order {
        if chosen.iter().all(|&c| neighbours[c][i]) {
            chosen.push(i);
        }
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_agreeing_set_is_kept_and_loners_are_not() {
        // 0, 2, 4, 6 agree; 1 and 3 agree with each other; 5 with nobody.
        let agree =
            |i: usize, j: usize| (i.is_multiple_of(2) && j.is_multiple_of(2)) || (i + j == 4 && i != j);
        assert_eq!(largest(7, agree), [0, 2, 4, 6]);
        assert_eq!(largest(3, |_, _| false), [0]);
        assert!(largest(0, |_, _| true).is_empty());
        assert_eq!(largest(100, |i, j| i % 3 == j % 3).len(), 34);
    }
}
