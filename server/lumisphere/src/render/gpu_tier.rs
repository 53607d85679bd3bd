//! What all datasets together have on the device: their kernels, least recently used first, under one budget.

use std::collections::VecDeque;
use std::sync::Arc;

use super::{CPU_KERNELS, Entry, Kernels, RenderError, Representation, UploadUnit};
use crate::gpu::{Gpu, GpuCacheStats, GpuError};
use crate::representations::GpuKernel;
use crate::textures::PolicyKind;

/// Everything on the device, and what it may hold.
pub(super) struct GpuTier {
    kernels: Kernels<Box<dyn GpuKernel>>,
    budget_bytes: u64,
    policy: PolicyKind,
    // Datasets that found too little room, and how much it was: the same room is not tried again.
    refused: VecDeque<(Arc<dyn Representation>, u64, RenderError)>,
    // Of datasets that left.
    earlier: GpuCacheStats,
    peak_bytes: u64,
}

impl GpuTier {
    /// Empty.
    pub fn new(budget_bytes: u64) -> Self {
        Self {
            kernels: Kernels::new(),
            budget_bytes,
            policy: PolicyKind::Lru,
            refused: VecDeque::new(),
            earlier: GpuCacheStats::default(),
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
        self.kernels.iter_mut().for_each(|(_, kernel)| kernel.set_policy(policy));
    }

    /// Of the datasets that are here.
    pub fn set_upload_unit(&mut self, unit: UploadUnit) {
        self.kernels.iter_mut().for_each(|(_, kernel)| kernel.set_upload_unit(unit));
    }

    /// How many datasets found too little room.
    #[cfg(test)]
    pub fn refused(&self) -> usize {
        self.refused.len()
    }

    fn held(&self) -> u64 {
        self.kernels.iter().map(|(_, k)| k.bytes()).sum()
    }

    /// Of all that were ever here.
    pub fn stats(&self) -> GpuCacheStats {
        let mut stats = GpuCacheStats { peak_device_bytes: self.peak_bytes, budget_bytes: self.budget_bytes, ..self.earlier };
        self.kernels.iter().for_each(|(_, kernel)| stats.add(&kernel.stats()));
        stats
    }

    /// The dataset's kernel, if it is there, out of the list while it works.
    pub fn take_known(&mut self, representation: &Arc<dyn Representation>) -> Option<Entry<Box<dyn GpuKernel>>> {
        let known = self.kernels.iter().position(|(r, _)| Arc::ptr_eq(r, representation))?;
        self.kernels.remove(known)
    }

    /// The same, made if it is not there. Two datasets of half the budget each can stay; a new one otherwise displaces those unused for
    /// longest.
    pub fn take(&mut self, gpu: &Arc<Gpu>, representation: &Arc<dyn Representation>) -> Result<Entry<Box<dyn GpuKernel>>, RenderError> {
        if let Some(entry) = self.take_known(representation) {
            return Ok(entry);
        }
        while self.held() > self.budget_bytes / 2 && self.give_up_oldest() {}
        let room = self.budget_bytes.saturating_sub(self.held());
        if let Some((_, _, error)) = self.refused.iter().find(|(r, tried, _)| Arc::ptr_eq(r, representation) && room <= *tried) {
            return Err(error.clone());
        }
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
        Ok((representation.clone(), kernel))
    }

    /// After [`Self::take`].
    pub fn put_back(&mut self, entry: Entry<Box<dyn GpuKernel>>) {
        self.kernels.push_back(entry);
        self.peak_bytes = self.peak_bytes.max(self.held());
    }

    /// What no longer fits leaves at once.
    pub fn set_budget(&mut self, budget_bytes: u64) {
        self.budget_bytes = budget_bytes;
        while self.kernels.len() > 1 && self.held() > budget_bytes {
            self.give_up_oldest();
        }
        if let Some((_, last)) = self.kernels.back() {
            let others = self.held() - last.bytes();
            if let Some((_, last)) = self.kernels.back_mut() {
                last.set_budget(budget_bytes.saturating_sub(others));
            }
        }
        // Geometry and sample maps of the last one may be too much by themselves.
        if self.held() > budget_bytes {
            self.give_up_oldest();
        }
    }

    /// The peak begins anew with what is held now.
    pub fn forget_peak(&mut self) {
        self.peak_bytes = self.held();
    }

    // False when there is none.
    fn give_up_oldest(&mut self) -> bool {
        let Some((_, kernel)) = self.kernels.pop_front() else { return false };
        self.earlier.add(&kernel.stats().after_all_left());
        true
    }
}
