// The rival of benches/fitting: Ceres 2.1, one problem a texel, Levenberg-Marquardt with bounds, one thread.
//
//   apt-get install libceres-dev
//   g++ -O3 -march=native -I/usr/include/eigen3 docs/rivals/ceres_lobes.cpp -lceres -lglog -o target/ceres_lobes
//
// Usage: ceres_lobes SAMPLES TEXELS VIEWS LOBES. SAMPLES: for each texel and view 6 f32 (unit direction, three values). Model: constant +
// sum of K max(r.d, 0)^m; K >= 0, m in [1, 1000], r = (x, y, sqrt(1 - x^2 - y^2)). Start: the mean, the brightest directions at least 20
// degrees apart, m = 10. Prints, for analytic derivatives with a Cholesky factorisation and for automatic ones with QR: microseconds of
// processor time per texel (median of five runs), root mean square residual, iterations.

#include <ceres/ceres.h>
#include <time.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

struct Texel { const float* samples; int views; int lobes; };

static double processor_seconds() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}

// Unknowns: constant (3), then per lobe K (3), x, y, m.
static int unknowns(int lobes) { return 3 + 6 * lobes; }

class Analytic : public ceres::CostFunction {
 public:
  explicit Analytic(const Texel& texel) : texel_(texel) {
    set_num_residuals(3 * texel.views);
    mutable_parameter_block_sizes()->push_back(unknowns(texel.lobes));
  }
  bool Evaluate(double const* const* blocks, double* residuals, double** jacobians) const override {
    const double* p = blocks[0];
    const int n = unknowns(texel_.lobes);
    double* jacobian = jacobians ? jacobians[0] : nullptr;
    if (jacobian) std::fill(jacobian, jacobian + 3 * texel_.views * n, 0.0);
    for (int i = 0; i < texel_.views; ++i) {
      const float* s = texel_.samples + 6 * i;
      double* r = residuals + 3 * i;
      for (int c = 0; c < 3; ++c) r[c] = p[c] - s[3 + c];
      if (jacobian) for (int c = 0; c < 3; ++c) jacobian[(3 * i + c) * n + c] = 1;
      for (int j = 0; j < texel_.lobes; ++j) {
        const double* q = p + 3 + 6 * j;
        const double z = std::sqrt(std::max(1 - q[3] * q[3] - q[4] * q[4], 1e-9));
        const double cosine = q[3] * s[0] + q[4] * s[1] + z * s[2];
        if (cosine <= 1e-9) continue;
        const double log_cosine = std::log(cosine), lobe = std::exp(q[5] * log_cosine);
        for (int c = 0; c < 3; ++c) r[c] += q[c] * lobe;
        if (!jacobian) continue;
        const double by_cosine = q[5] * lobe / cosine;
        for (int c = 0; c < 3; ++c) {
          double* row = jacobian + (3 * i + c) * n + 3 + 6 * j;
          row[c] = lobe;
          row[3] = q[c] * by_cosine * (s[0] - q[3] / z * s[2]);
          row[4] = q[c] * by_cosine * (s[1] - q[4] / z * s[2]);
          row[5] = q[c] * lobe * log_cosine;
        }
      }
    }
    return true;
  }

 private:
  Texel texel_;
};

struct Automatic {
  const float* s;
  int lobes;
  template <typename T>
  bool operator()(T const* const* blocks, T* r) const {
    const T* p = blocks[0];
    for (int c = 0; c < 3; ++c) r[c] = p[c] - T(s[3 + c]);
    for (int j = 0; j < lobes; ++j) {
      const T* q = p + 3 + 6 * j;
      const T square = T(1) - q[3] * q[3] - q[4] * q[4];
      const T z = sqrt(square < T(1e-9) ? T(1e-9) : square);
      const T cosine = q[3] * T(s[0]) + q[4] * T(s[1]) + z * T(s[2]);
      if (cosine <= T(1e-9)) continue;
      const T lobe = exp(q[5] * log(cosine));
      for (int c = 0; c < 3; ++c) r[c] += q[c] * lobe;
    }
    return true;
  }
};

static std::vector<double> start(const Texel& texel) {
  std::vector<double> p(unknowns(texel.lobes));
  for (int i = 0; i < texel.views; ++i)
    for (int c = 0; c < 3; ++c) p[c] += texel.samples[6 * i + 3 + c] / double(texel.views);
  std::vector<int> taken;
  for (int j = 0; j < texel.lobes; ++j) {
    int best = 0;
    double most = -1e30;
    for (int i = 0; i < texel.views; ++i) {
      const float* s = texel.samples + 6 * i;
      const double height = s[3] + s[4] + s[5];
      bool free = height > most;
      for (int other : taken) {
        const float* o = texel.samples + 6 * other;
        free = free && s[0] * o[0] + s[1] * o[1] + s[2] * o[2] < 0.94;
      }
      if (free) { most = height; best = i; }
    }
    taken.push_back(best);
    const float* s = texel.samples + 6 * best;
    double* q = &p[3 + 6 * j];
    for (int c = 0; c < 3; ++c) q[c] = std::max(0.01, s[3 + c] - p[c]);
    q[3] = s[0], q[4] = s[1], q[5] = 10;
  }
  return p;
}

struct Outcome { double cost; int iterations; };

static Outcome solve(const Texel& texel, bool analytic) {
  std::vector<double> p = start(texel);
  ceres::Problem problem;
  if (analytic) {
    problem.AddResidualBlock(new Analytic(texel), nullptr, p.data());
  } else {
    for (int i = 0; i < texel.views; ++i) {
      auto* cost = new ceres::DynamicAutoDiffCostFunction<Automatic, 9>(new Automatic{texel.samples + 6 * i, texel.lobes});
      cost->AddParameterBlock(unknowns(texel.lobes));
      cost->SetNumResiduals(3);
      problem.AddResidualBlock(cost, nullptr, p.data());
    }
  }
  for (int c = 0; c < 3; ++c) problem.SetParameterLowerBound(p.data(), c, 0);
  for (int j = 0; j < texel.lobes; ++j) {
    const int at = 3 + 6 * j;
    for (int c = 0; c < 3; ++c) problem.SetParameterLowerBound(p.data(), at + c, 0);
    for (int c = 3; c < 5; ++c) {
      problem.SetParameterLowerBound(p.data(), at + c, -1);
      problem.SetParameterUpperBound(p.data(), at + c, 1);
    }
    problem.SetParameterLowerBound(p.data(), at + 5, 1);
    problem.SetParameterUpperBound(p.data(), at + 5, 1000);
  }
  ceres::Solver::Options options;
  options.linear_solver_type = analytic ? ceres::DENSE_NORMAL_CHOLESKY : ceres::DENSE_QR;
  options.max_num_iterations = 100;
  options.logging_type = ceres::SILENT;
  options.num_threads = 1;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  return {2 * summary.final_cost, int(summary.iterations.size())};
}

int main(int argc, char** argv) {
  if (argc != 5) { std::fprintf(stderr, "usage: ceres_lobes SAMPLES TEXELS VIEWS LOBES\n"); return 2; }
  const int texels = std::atoi(argv[2]), views = std::atoi(argv[3]), lobes = std::atoi(argv[4]);
  std::vector<float> samples(size_t(texels) * views * 6);
  FILE* file = std::fopen(argv[1], "rb");
  if (!file || std::fread(samples.data(), sizeof(float), samples.size(), file) != samples.size()) { std::perror(argv[1]); return 1; }
  std::fclose(file);
  for (bool analytic : {true, false}) {
    std::vector<double> seconds;
    double cost = 0, iterations = 0, worst = 0;
    for (int run = 0; run < 5; ++run) {
      cost = iterations = worst = 0;
      const double begin = processor_seconds();
      for (int t = 0; t < texels; ++t) {
        const Outcome outcome = solve({&samples[size_t(t) * views * 6], views, lobes}, analytic);
        cost += outcome.cost, iterations += outcome.iterations, worst = std::max(worst, outcome.cost);
      }
      seconds.push_back(processor_seconds() - begin);
    }
    std::sort(seconds.begin(), seconds.end());
    const char* name = analytic ? "analytic" : "automatic";
    std::printf("%s_us %.4f\n%s_rms %.9g\n%s_iterations %.2f\n", name, 1e6 * seconds[2] / texels, name, std::sqrt(cost / (3.0 * views * texels)), name, iterations / texels);
  }
  return 0;
}
