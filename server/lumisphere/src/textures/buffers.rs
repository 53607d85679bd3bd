//! The buffers of pages that are gone, for the pages that come after them: a miss asks neither the allocator nor the system for memory,
//! which for whole pages is either slow (every 4 KiB of a new mapping is a fault) or scattered over the heaps of all threads.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use half::f16;

/// Most bytes that wait to be used again, for each type of number; what comes in makes room for itself.
const KEPT_BYTES: usize = 1 << 20;

/// Oldest first.
#[derive(Debug)]
pub(super) struct Buffers<T>(Mutex<VecDeque<Vec<T>>>);

/// A number that texels are made of.
pub(super) trait Number: Sized + 'static {
    /// Of the whole process: pages outlive caches.
    fn buffers() -> &'static Buffers<Self>;
}

impl Number for f32 {
    fn buffers() -> &'static Buffers<Self> {
        static BUFFERS: Buffers<f32> = Buffers::new();
        &BUFFERS
    }
}

impl Number for f16 {
    fn buffers() -> &'static Buffers<Self> {
        static BUFFERS: Buffers<f16> = Buffers::new();
        &BUFFERS
    }
}

impl<T> Buffers<T> {
    const fn new() -> Self {
        Self(Mutex::new(VecDeque::new()))
    }

    /// Empty, with room for `count` numbers.
    pub fn take(&self, count: usize) -> Vec<T> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // The newest is likeliest to be in a processor's cache still.
        let at = kept.iter().rposition(|buffer| buffer.capacity() == count);
        let found = at.and_then(|at| kept.remove(at));
        drop(kept);
        found.unwrap_or_else(|| Vec::with_capacity(count))
    }

    /// Keeps the buffer, not what is in it.
    pub fn give(&self, mut buffer: Vec<T>) {
        let bytes = |buffer: &Vec<T>| buffer.capacity() * size_of::<T>();
        buffer.clear();
        if buffer.capacity() == 0 || bytes(&buffer) > KEPT_BYTES {
            return;
        }
        let mut freed = Vec::new();
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all = kept.iter().map(bytes).sum::<usize>() + bytes(&buffer);
        while all > KEPT_BYTES {
            let oldest = kept.pop_front();
            all -= oldest.as_ref().map_or(all, bytes);
            freed.extend(oldest);
        }
        kept.push_back(buffer);
        // Returned to the allocator behind the lock.
        drop(kept);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_comes_back_empty_where_its_size_is_asked_for() {
        let buffers = Buffers::<f32>::new();
        let mut buffer = buffers.take(10);
        buffer.extend([1.0; 10]);
        let address = buffer.as_ptr();
        buffers.give(buffer);
        let of_another_size = buffers.take(9);
        let again = buffers.take(10);
        assert_eq!((again.as_ptr(), again.len(), again.capacity()), (address, 0, 10));
        let one_more = buffers.take(10);
        assert!(![of_another_size, one_more].iter().any(|buffer| buffer.as_ptr() == address));
    }

    #[test]
    fn no_more_than_the_limit_is_kept_and_the_newest_stay() {
        let buffers = Buffers::<f16>::new();
        let count = KEPT_BYTES / 4 / size_of::<f16>();
        let given: Vec<Vec<f16>> = (0..6).map(|_| Vec::with_capacity(count)).collect();
        let addresses: Vec<_> = given.iter().map(|buffer| buffer.as_ptr()).collect();
        given.into_iter().for_each(|buffer| buffers.give(buffer));
        buffers.give(Vec::with_capacity(KEPT_BYTES));
        buffers.give(Vec::new());
        let kept: Vec<_> = buffers.0.lock().unwrap().iter().map(|buffer| buffer.as_ptr()).collect();
        assert_eq!(kept, addresses[2..]);
    }
}
