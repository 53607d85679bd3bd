//! The texture cache.

use tonic::{Request, Response, Status};

use super::{Api, App, blocking};
use crate::errors::ApiError;
use crate::wire::datasets::cache_stats;
use crate::wire::proto::{self, cache_server::Cache};

/// More than any machine has; above it a slip of the pen is likelier.
const MAX_BUDGET_BYTES: u64 = 1 << 44;

#[tonic::async_trait]
impl Cache for Api {
    async fn get_cache_stats(&self, _: Request<proto::GetCacheStatsRequest>) -> Result<Response<proto::CacheStats>, Status> {
        Ok(Response::new(stats(&self.0)))
    }

    async fn configure_cache(&self, request: Request<proto::ConfigureCacheRequest>) -> Result<Response<proto::CacheStats>, Status> {
        let app = self.0.clone();
        let Some(bytes) = request.into_inner().memory_budget_bytes else { return Ok(Response::new(stats(&app))) };
        if bytes > MAX_BUDGET_BYTES {
            return Err(ApiError::field("memory_budget_bytes", format!("{bytes}, at most {MAX_BUDGET_BYTES} expected")).into());
        }
        let now = blocking(move || {
            app.catalog.set_cache_budget(bytes);
            Ok(stats(&app))
        });
        Ok(Response::new(now.await?))
    }

    async fn clear_cache(&self, request: Request<proto::ClearCacheRequest>) -> Result<Response<proto::CacheStats>, Status> {
        let app = self.0.clone();
        let now = blocking(move || {
            app.catalog.clear_cache();
            if request.into_inner().reset_counters {
                app.catalog.reset_cache_counters();
            }
            Ok(stats(&app))
        });
        Ok(Response::new(now.await?))
    }
}

fn stats(app: &App) -> proto::CacheStats {
    let (now, baseline) = app.catalog.cache_stats();
    cache_stats(&now, &baseline)
}
