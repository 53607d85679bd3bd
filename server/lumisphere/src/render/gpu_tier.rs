//! What all datasets together have on the device: their kernels, least recently used first, under one budget.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::{CPU_KERNELS, RenderError, Representation, UploadUnit};
use crate::gpu::{Gpu, GpuCacheStats, GpuError};
use crate::representations::GpuKernel;
use crate::textures::PolicyKind;

/// One dataset version on the device.
pub(super) struct Resident {
    representation: Arc<dyn Representation>,
    version_slot: u32,
    pub kernel: Box<dyn GpuKernel>,
}

/// Of one dataset version, whether it is on the device or not.
#[derive(Default)]
struct Account {
    // Of its kernels that left.
    earlier: GpuCacheStats,
    peak_bytes: u64,
}

/// Everything on the device, and what it may hold.
pub(super) struct GpuTier {
    residents: VecDeque<Resident>,
    budget_bytes: u64,
    policy: PolicyKind,
    // Datasets that found too little room, and how much it was: the same room is not tried again.
    refused: VecDeque<(Arc<dyn Representation>, u64, RenderError)>,
    // By version slot: every version that was ever here, a few words each.
    accounts: BTreeMap<u32, Account>,
    peak_bytes: u64,
}

impl GpuTier {
    /// Empty.
    pub fn new(budget_bytes: u64) -> Self {
        Self {
            residents: VecDeque::new(),
            budget_bytes,
            policy: PolicyKind::Lru,
            refused: VecDeque::new(),
            accounts: BTreeMap::new(),
            peak_bytes: 0,
        }
    }

    /// Which pages leave first.
    pub fn policy(&self) -> PolicyKind {
        self.policy
    }

    /// Of every dataset, those to come included.
    pub fn set_policy(&mut self, policy: PolicyKind) {
        self.policy = policy;
        self.residents.iter_mut().for_each(|resident| resident.kernel.set_policy(policy));
    }

    /// Of the datasets that are here.
    pub fn set_upload_unit(&mut self, unit: UploadUnit) {
        self.residents.iter_mut().for_each(|resident| resident.kernel.set_upload_unit(unit));
    }

    /// How many datasets found too little room.
    #[cfg(test)]
    pub fn refused(&self) -> usize {
        self.refused.len()
    }

    fn held(&self) -> u64 {
        self.residents.iter().map(|resident| resident.kernel.bytes()).sum()
    }

    fn held_by(&self, version_slot: u32) -> u64 {
        self.residents.iter().filter(|r| r.version_slot == version_slot).map(|r| r.kernel.bytes()).sum()
    }

    /// Of all that were ever here.
    pub fn stats(&self) -> GpuCacheStats {
        let nothing = GpuCacheStats { peak_device_bytes: self.peak_bytes, budget_bytes: self.budget_bytes, ..GpuCacheStats::default() };
        self.stats_by_version().fold(nothing, |mut sum, (_, stats)| {
            sum.add(&stats);
            sum
        })
    }

    /// The same of each version slot, ascending; the budget is everyone's.
    pub fn stats_by_version(&self) -> impl Iterator<Item = (u32, GpuCacheStats)> {
        self.accounts.iter().map(|(slot, account)| {
            let mut stats = GpuCacheStats { peak_device_bytes: account.peak_bytes, budget_bytes: self.budget_bytes, ..account.earlier };
            self.residents.iter().filter(|r| r.version_slot == *slot).for_each(|r| stats.add(&r.kernel.stats()));
            (*slot, stats)
        })
    }

    /// The dataset, if it is there, out of the list while it works.
    pub fn take_known(&mut self, representation: &Arc<dyn Representation>) -> Option<Resident> {
        let known = self.residents.iter().position(|r| Arc::ptr_eq(&r.representation, representation))?;
        self.residents.remove(known)
    }

    /// The same, made if it is not there. Two datasets of half the budget each can stay; a new one otherwise displaces those unused for
    /// longest.
    pub fn take(&mut self, gpu: &Arc<Gpu>, representation: &Arc<dyn Representation>, version_slot: u32) -> Result<Resident, RenderError> {
        if let Some(resident) = self.take_known(representation) {
            return Ok(resident);
        }
        while self.held() > self.budget_bytes / 2 && self.give_up_oldest() {}
        let room = self.budget_bytes.saturating_sub(self.held());
        if let Some((_, _, error)) = self.refused.iter().find(|(r, tried, _)| Arc::ptr_eq(r, representation) && room <= *tried) {
            return Err(error.clone());
        }
        // What was drawn before shall not wait for a kernel.
        gpu.settle();
        let mut kernel = match representation.clone().gpu_kernel(gpu, room) {
            Ok(kernel) => kernel,
            Err(error) => {
                let is_for_want_of_room = matches!(error, GpuError::OverBudget { .. });
                let error = RenderError::from(error);
                // A device that failed may work again; a room that was too small stays so.
                if is_for_want_of_room {
                    self.refused.retain(|(r, ..)| !Arc::ptr_eq(r, representation));
                    self.refused.push_back((representation.clone(), room, error.clone()));
                }
                if self.refused.len() > CPU_KERNELS {
                    self.refused.pop_front();
                }
                gpu.release_dropped();
                return Err(error);
            }
        };
        kernel.set_policy(self.policy);
        Ok(Resident { representation: representation.clone(), version_slot, kernel })
    }

    /// After [`Self::take`].
    pub fn put_back(&mut self, resident: Resident) {
        let version_slot = resident.version_slot;
        self.residents.push_back(resident);
        self.peak_bytes = self.peak_bytes.max(self.held());
        let held = self.held_by(version_slot);
        let account = self.accounts.entry(version_slot).or_default();
        account.peak_bytes = account.peak_bytes.max(held);
    }

    /// What no longer fits leaves at once.
    pub fn set_budget(&mut self, budget_bytes: u64) {
        self.budget_bytes = budget_bytes;
        while self.residents.len() > 1 && self.held() > budget_bytes {
            self.give_up_oldest();
        }
        let held = self.held();
        if let Some(Resident { kernel: last, .. }) = self.residents.back_mut() {
            let others = held - last.bytes();
            last.set_budget(budget_bytes.saturating_sub(others));
        }
        // Geometry and sample maps of the last one may be too much by themselves.
        if self.held() > budget_bytes {
            self.give_up_oldest();
        }
    }

    /// The peaks begin anew with what is held now.
    pub fn forget_peaks(&mut self) {
        self.peak_bytes = self.held();
        let held: Vec<u64> = self.accounts.keys().map(|slot| self.held_by(*slot)).collect();
        self.accounts.values_mut().zip(held).for_each(|(account, held)| account.peak_bytes = held);
    }

    /// All of it is gone with the device.
    pub fn lose_all(&mut self) {
        while self.give_up_oldest() {}
        self.refused.clear();
    }

    // False when there is none.
    fn give_up_oldest(&mut self) -> bool {
        let Some(Resident { version_slot, kernel, .. }) = self.residents.pop_front() else { return false };
        self.accounts.entry(version_slot).or_default().earlier.add(&kernel.stats().after_all_left());
        true
    }
}
