//! Eight rays together meet what each meets alone, with every kind of register.

use glam::Vec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::raytrace::bvh::Bvh;
use crate::raytrace::packets::{PacketStack, RAYS, RayPacket};
use crate::raytrace::traverse::{RawHit, Stack};

fn random_vec(random: &mut Pcg32) -> Vec3 {
    Vec3::new(random.random::<f32>(), random.random::<f32>(), random.random::<f32>()) * 2.0 - 1.0
}

fn soup(random: &mut Pcg32, count: usize, size: f32) -> Bvh {
    let triangles: Vec<[Vec3; 3]> = (0..count)
        .map(|_| {
            let at = random_vec(random);
            [0, 1, 2].map(|_| at + size * random_vec(random))
        })
        .collect();
    Bvh::build(&triangles)
}

/// Origin, direction, limit.
type Ray = (Vec3, Vec3, f32);

/// Rays of one point into a narrow cone, of many points in one direction, and of no order at all; along axes; with an end; fewer than eight.
fn bundle(random: &mut Pcg32, kind: usize) -> Vec<Ray> {
    let (origin, direction) = (2.0 * random_vec(random), random_vec(random));
    let ray = |random: &mut Pcg32| match kind % 5 {
        0 => (origin, direction + 0.02 * random_vec(random), f32::INFINITY),
        1 => (origin + 0.1 * random_vec(random), direction, f32::INFINITY),
        2 => (2.0 * random_vec(random), random_vec(random), f32::INFINITY),
        3 => (random_vec(random), Vec3::AXES[random.random_range(0..3)] * if random.random() { 1.0 } else { -1.0 }, f32::INFINITY),
        _ => (random_vec(random), random_vec(random), random.random::<f32>()),
    };
    (0..1 + kind % RAYS).map(|_| ray(random)).collect()
}

fn packet(rays: &[Ray]) -> RayPacket {
    let mut packet = RayPacket::EMPTY;
    rays.iter().enumerate().for_each(|(lane, (origin, direction, limit))| packet.set(lane, *origin, *direction, *limit));
    packet
}

#[test]
fn a_packet_meets_to_the_bit_what_its_rays_meet_alone() {
    let mut random = Pcg32::seed_from_u64(21);
    let (mut hits, mut misses) = (0, 0);
    for (count, size) in [(1usize, 1.0), (7, 0.7), (500, 0.2), (4000, 0.05)] {
        let bvh = soup(&mut random, count, size);
        let (mut stack, mut packets) = (Stack::new(), PacketStack::default());
        for kind in 0..2000 {
            let rays = bundle(&mut random, kind);
            let alone: Vec<Option<RawHit>> = rays.iter().map(|(o, d, limit)| bvh.nearest(*o, *d, *limit, &mut stack)).collect();
            let met = bvh.nearest_of_packet(&packet(&rays), &mut packets);
            assert_eq!(met[..rays.len()], alone);
            assert!(met[rays.len()..].iter().all(Option::is_none));
            let blocked = bvh.any_of_packet(&packet(&rays), &mut packets);
            let expected = alone.iter().enumerate().fold(0, |bits, (lane, hit)| bits | u32::from(hit.is_some()) << lane);
            assert_eq!(blocked, expected, "{rays:?}");
            hits += expected.count_ones();
            misses += rays.len() as u32 - expected.count_ones();
        }
    }
    assert!(hits > 3000 && misses > 3000, "{hits} hits, {misses} misses: too few to tell");
}

#[test]
fn every_kind_of_register_gives_the_same_bits() {
    // Where the processor has nothing wider both are the same code, and this says nothing.
    let mut random = Pcg32::seed_from_u64(22);
    let bvh = soup(&mut random, 3000, 0.1);
    let mut stack = PacketStack::default();
    for kind in 0..4000 {
        let rays = packet(&bundle(&mut random, kind));
        assert_eq!(bvh.nearest_of_packet(&rays, &mut stack), bvh.nearest_of_packet_portably(&rays, &mut stack));
        assert_eq!(bvh.any_of_packet(&rays, &mut stack), bvh.any_of_packet_portably(&rays, &mut stack));
    }
}

#[test]
fn rays_that_are_not_finite_and_empty_trees_meet_nothing() {
    let mut random = Pcg32::seed_from_u64(23);
    let bvh = soup(&mut random, 100, 0.5);
    let mut stack = PacketStack::default();
    let broken: Vec<Ray> = vec![
        (Vec3::NAN, Vec3::X, f32::INFINITY),
        (Vec3::ZERO, Vec3::new(0.0, f32::NAN, 1.0), f32::INFINITY),
        (Vec3::ZERO, Vec3::new(f32::INFINITY, 0.0, 0.0), f32::INFINITY),
        (Vec3::ZERO, Vec3::ZERO, f32::INFINITY),
        (Vec3::ZERO, Vec3::X, 0.0),
        (Vec3::ZERO, Vec3::X, f32::NAN),
    ];
    assert_eq!(bvh.nearest_of_packet(&packet(&broken), &mut stack), [None; RAYS]);
    assert_eq!(bvh.any_of_packet(&packet(&broken), &mut stack), 0);
    let sound = packet(&bundle(&mut random, 7));
    assert_eq!(Bvh::build(&[]).nearest_of_packet(&sound, &mut stack), [None; RAYS]);
    assert_eq!(bvh.any_of_packet(&RayPacket::EMPTY, &mut stack), 0);
}
