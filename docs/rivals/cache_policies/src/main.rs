//! `cache_policies VISITS CAPACITY…`: misses of moka, foyer and quick_cache on a file of little-endian u32 page numbers, one line a cache
//! and capacity (in pages): name, capacity, misses, most pages held.

use foyer_memory::{Cache as Foyer, CacheBuilder, EvictionConfig, LfuConfig, LruConfig, S3FifoConfig};

fn main() {
    let mut arguments = std::env::args().skip(1);
    let file = std::fs::read(arguments.next().expect("a file of visits")).expect("the visits can be read");
    let visits: Vec<u32> = file.chunks_exact(4).map(|b| u32::from_le_bytes(b.try_into().expect("four bytes"))).collect();
    for capacity in arguments.map(|a| a.parse::<usize>().expect("a capacity in pages")) {
        moka("moka", capacity, &visits, moka::policy::EvictionPolicy::tiny_lfu());
        moka("moka-lru", capacity, &visits, moka::policy::EvictionPolicy::lru());
        quick(capacity, &visits);
        foyer("foyer-lru", LruConfig::default().into(), capacity, &visits);
        foyer("foyer-s3fifo", S3FifoConfig::default().into(), capacity, &visits);
        foyer("foyer-lfu", LfuConfig::default().into(), capacity, &visits);
    }
}

fn report(name: &str, capacity: usize, misses: u64, most: usize) {
    println!("{name} {capacity} {misses} {most}");
}

/// Pending work is done at once: left to itself moka holds more than its capacity.
fn moka(name: &str, capacity: usize, visits: &[u32], policy: moka::policy::EvictionPolicy) {
    let cache = moka::sync::Cache::builder().max_capacity(capacity as u64).eviction_policy(policy).build();
    let (mut misses, mut most) = (0, 0);
    for &page in visits {
        if cache.get(&page).is_none() {
            misses += 1;
            cache.insert(page, ());
        }
        cache.run_pending_tasks();
        most = most.max(cache.entry_count() as usize);
    }
    report(name, capacity, misses, most);
}

fn quick(capacity: usize, visits: &[u32]) {
    let mut cache = quick_cache::unsync::Cache::new(capacity);
    let (mut misses, mut most) = (0, 0);
    for &page in visits {
        if cache.get(&page).is_none() {
            misses += 1;
            cache.insert(page, ());
        }
        most = most.max(cache.len());
    }
    report("quick_cache", capacity, misses, most);
}

fn foyer(name: &str, policy: EvictionConfig, capacity: usize, visits: &[u32]) {
    let cache: Foyer<u32, ()> = CacheBuilder::new(capacity).with_shards(1).with_eviction_config(policy).build();
    let (mut misses, mut most) = (0, 0);
    for &page in visits {
        if cache.get(&page).is_none() {
            misses += 1;
            cache.insert(page, ());
        }
        most = most.max(cache.usage());
    }
    report(name, capacity, misses, most);
}
