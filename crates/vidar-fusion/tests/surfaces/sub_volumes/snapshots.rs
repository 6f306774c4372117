//! Sub-volumes that leave the memory, and a sum that is kept.

use super::{add, colored, dealt, revised, same_bits, settings};
use crate::common::{Vec3, ball, config, views_around};
use vidar_core::random::SplitMix64;
use vidar_core::{AlignedView, ChunkId, LieGroup, Sim3, So3};
use vidar_fusion::{FusionConfig, FusionError, SubVolumes};

#[test]
fn offloaded_chunks_move_and_merge_like_those_in_memory() {
    let views: Vec<AlignedView> = views_around(130, 1.3, ball(0.4)).into_iter().map(colored).collect();
    let fusion = FusionConfig { carve_range_m: 2.0, voxel_size_m: 0.04, ..config() };
    let mut in_memory = dealt(&settings(fusion.clone()), &views, 5);
    let mut offloaded = in_memory.clone();
    let mut stored = std::collections::BTreeMap::new();
    let full = offloaded.memory_bytes();
    for chunk in 0..4 {
        stored.insert(ChunkId(chunk), offloaded.offload(ChunkId(chunk)).unwrap());
    }
    let bytes: usize = stored.values().map(Vec::len).sum();
    assert!(offloaded.memory_bytes() < full / 3 && (bytes as u64) < full / 2, "{bytes} of {full}");
    assert_eq!(offloaded.offloaded().collect::<Vec<_>>(), (0..4).map(ChunkId).collect::<Vec<_>>());
    let by = Sim3::new(So3::exp(&Vec3::new(0.0, 0.1, 0.2)), Vec3::new(0.1, 0.0, 0.2), 0.98).unwrap();
    for volumes in [&mut in_memory, &mut offloaded] {
        let moves: Vec<_> = views[26..52].iter().map(|v| revised(v, &by)).collect();
        assert!(volumes.revise(ChunkId(1), &moves).unwrap().stale);
    }
    let expected = in_memory.extract_mesh().unwrap();
    let load = |chunk: ChunkId| Ok::<_, FusionError>(stored[&chunk].clone());
    assert!(same_bits(&expected, &offloaded.clone().merged_with(load).unwrap().extract_mesh()));
    assert_eq!(offloaded.merged().unwrap_err(), FusionError::Offloaded { chunk: ChunkId(0) });
    assert_eq!(offloaded.offload(ChunkId(0)).unwrap_err(), FusionError::Offloaded { chunk: ChunkId(0) });
    let late = &views_around(131, 1.3, ball(0.4))[130];
    assert!(matches!(offloaded.integrate(ChunkId(0), late), Err(FusionError::Offloaded { .. })));
    assert_eq!(in_memory.offload(ChunkId(2)).unwrap(), stored[&ChunkId(2)], "equal volumes, equal bytes");
}

#[test]
fn corrupt_bytes_are_an_error_and_never_panic() {
    let views = views_around(6, 1.3, ball(0.4));
    let fusion = FusionConfig { carve_range_m: 1.0, voxel_size_m: 0.05, ..config() };
    let mut volumes = dealt(&settings(fusion), &views, 1);
    let good = volumes.offload(ChunkId(0)).unwrap();
    let mut random = SplitMix64::new(1);
    let mut rejected = 0;
    for round in 0..400 {
        let mut bytes = good.clone();
        if round % 2 == 0 {
            bytes.truncate(random.below(good.len()));
        } else {
            bytes[random.below(good.len())] ^= 1 << random.below(8);
        }
        // A flipped bit of a sum may still be a sum; whatever is read can be made a mesh.
        match volumes.clone().merged_with(|_| Ok::<_, FusionError>(bytes.clone())) {
            Ok(volume) => drop(volume.extract_mesh()),
            Err(FusionError::BadSnapshot { .. }) => rejected += 1,
            Err(other) => panic!("{other}"),
        }
    }
    assert!(rejected >= 200, "{rejected}");
    let read = |bytes: &[u8]| {
        let mut volumes = volumes.clone();
        volumes.merged_with(|_| Ok::<_, FusionError>(bytes.to_vec())).map(|volume| volume.extract_mesh())
    };
    assert!(read(b"VSUB2").is_err());
    let mut endless = b"VSUB1".to_vec();
    endless.extend([0xFF; 20]);
    assert!(read(&endless).is_err());
    assert!(read(&good).unwrap().positions.len() > 100);
}

/// A sum that is kept from surface to surface has the bits of one that is made at the end.
#[test]
fn a_kept_sum_forgets_nothing_and_keeps_nothing_too_much() {
    let views: Vec<AlignedView> = views_around(40, 1.3, ball(0.4)).into_iter().map(colored).collect();
    let fusion = FusionConfig { carve_range_m: 2.0, ..config() };
    let mut kept = SubVolumes::new(&settings(fusion)).unwrap();
    // Goes through all that `kept` does, but only copies of it are merged: nothing is kept.
    let mut bare = kept.clone();
    let mut stored = std::collections::BTreeMap::<ChunkId, Vec<u8>>::new();
    for (chunk, part) in (0..).map(ChunkId).zip(views.chunks(8)) {
        add(&mut kept, chunk, part);
        add(&mut bare, chunk, part);
        // Every chunk so far is turned about the last one, the older ones farther; some come back.
        for (k, earlier) in (0..chunk.0).zip(views.chunks(8)) {
            let angle = 0.03 * f64::from((chunk.0 - k) % 3);
            let motion =
                Sim3::new(So3::exp(&Vec3::new(0.0, 0.0, angle)), Vec3::zeros(), 1.0 + angle).unwrap();
            let moves: Vec<_> = earlier.iter().map(|v| revised(v, &motion)).collect();
            kept.revise(ChunkId(k), &moves).unwrap();
            bare.revise(ChunkId(k), &moves).unwrap();
        }
        let load = |c: ChunkId| Ok::<_, FusionError>(stored[&c].clone());
        let mesh = kept.merged_with(load).unwrap().extract_mesh();
        assert!(same_bits(&mesh, &bare.clone().merged_with(load).unwrap().extract_mesh()), "{chunk}");
        if chunk.0 > 0 {
            let old = ChunkId(chunk.0 - 1);
            stored.insert(old, kept.offload(old).unwrap());
            assert_eq!(bare.offload(old).unwrap(), stored[&old]);
        }
    }
    // More views of a chunk that is in the sum already, and one that is made anew.
    let last = ChunkId(4);
    let more = colored(views_around(41, 1.3, ball(0.4)).remove(40));
    for volumes in [&mut kept, &mut bare] {
        volumes.integrate(last, &more).unwrap();
        volumes.rebuild(ChunkId(1), views[8..16].to_vec()).unwrap();
    }
    let load = |c: ChunkId| Ok::<_, FusionError>(stored[&c].clone());
    let mesh = kept.merged_with(load).unwrap().extract_mesh();
    assert!(same_bits(&mesh, &bare.merged_with(load).unwrap().extract_mesh()));
    assert_eq!(kept.merged_with(load).unwrap().views(), 41);
}
