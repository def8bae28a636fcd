// The textbook filter with Eigen's dense fixed-size matrices: one step in Joseph's form, S by Cholesky.
// Compiled by roads.py and called through ctypes on the same arrays that driftlab gets.
#include <Eigen/Dense>

template <int n, int m>
static void run(long N, double* x_, double* P_, const double* F_, const double* Q_, const double* u_,
                const double* z_, const double* H_, const double* R_, double* out_x, double* out_sigma) {
  using Mnn = Eigen::Matrix<double, n, n, Eigen::RowMajor>;
  using Mmn = Eigen::Matrix<double, m, n, Eigen::RowMajor>;
  using Mnm = Eigen::Matrix<double, n, m>;
  using Mmm = Eigen::Matrix<double, m, m, Eigen::RowMajor>;
  using Vn = Eigen::Matrix<double, n, 1>;
  using Vm = Eigen::Matrix<double, m, 1>;
  Vn x = Eigen::Map<Vn>(x_);
  Mnn P = Eigen::Map<Mnn>(P_);
  const Mmn H = Eigen::Map<const Mmn>(H_);
  const Mmm R = Eigen::Map<const Mmm>(R_);
  for (long k = 0; k < N; ++k) {
    const Eigen::Map<const Mnn> F(F_ + k * n * n), Q(Q_ + k * n * n);
    x = (F * x + Eigen::Map<const Vn>(u_ + k * n)).eval();
    const Mnn FP = F * P;
    P.noalias() = FP * F.transpose();
    P += Q;
    const Mnm PH = P * H.transpose();
    const Mmm S = H * PH + R;
    const Mnm K = S.llt().solve(PH.transpose()).transpose();
    const Vm y = Eigen::Map<const Vm>(z_ + k * m) - H * x;
    x += K * y;
    const Mnn B = Mnn::Identity() - K * H;
    const Mnn BP = B * P;
    P.noalias() = BP * B.transpose();
    const Mnm KR = K * R;
    P.noalias() += KR * K.transpose();
    Eigen::Map<Vn>(out_x + k * n) = x;
    Eigen::Map<Vn>(out_sigma + k * n) = P.diagonal().cwiseSqrt();
  }
}

#define CASE(n, m)                                                                                       \
  extern "C" void joseph_##n##_##m(long N, double* x, double* P, const double* F, const double* Q,       \
                                   const double* u, const double* z, const double* H, const double* R,   \
                                   double* out_x, double* out_sigma) {                                   \
    run<n, m>(N, x, P, F, Q, u, z, H, R, out_x, out_sigma);                                              \
  }
CASE(12, 6)
CASE(24, 6)
