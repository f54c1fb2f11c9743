// A C interface to robot_localization's Ekf: a whole run of measurements in, states and covariances out.
#include <robot_localization/ekf.h>

#include <cstring>
#include <limits>

using RobotLocalization::Ekf;
using RobotLocalization::Measurement;

namespace {
constexpr int kStates = 15;  // x y z roll pitch yaw, their rates, accelerations
using Vector = Eigen::Map<const Eigen::VectorXd>;
}  // namespace

// Times in seconds, arrays row by row.
//   noise: variances of the process per second (15).
//   count measurements in their order: times (count), values, variances and update flags (count x 15), thresholds
//   (count): Mahalanobis distance above which one is rejected, 0: none is.
//   asked poses: after how many measurements (asked), at which time (asked), not before the last of these.
//   states (asked x 15) and covariances (asked x 15 x 15) are written.
extern "C" void filter_run(const double* noise, int count, const double* times, const double* values,
                           const double* variances, const int* update, const double* thresholds, int asked,
                           const int* after, const double* asked_times, double* states, double* covariances) {
  Ekf ekf;
  ekf.setProcessNoiseCovariance(Vector(noise, kStates).asDiagonal());
  ekf.setEstimateErrorCovariance(Eigen::MatrixXd::Identity(kStates, kStates));
  Measurement measurement;
  measurement.latestControl_ = Eigen::VectorXd::Zero(6);
  int next = 0;
  for (int i = 0; i < asked; ++i) {
    for (; next < after[i]; ++next) {
      const double threshold = thresholds[next];
      measurement.time_ = times[next];
      measurement.measurement_ = Vector(values + next * kStates, kStates);
      measurement.covariance_ = Vector(variances + next * kStates, kStates).asDiagonal();
      measurement.updateVector_.assign(update + next * kStates, update + (next + 1) * kStates);
      measurement.mahalanobisThresh_ = threshold > 0.0 ? threshold : std::numeric_limits<double>::max();
      ekf.processMeasurement(measurement);
    }
    Ekf ahead = ekf;
    const double seconds = asked_times[i] - ekf.getLastMeasurementTime();
    if (seconds > 0.0) ahead.predict(asked_times[i], seconds);
    std::memcpy(states + i * kStates, ahead.getState().data(), kStates * sizeof(double));
    const Eigen::Matrix<double, kStates, kStates, Eigen::RowMajor> cov = ahead.getEstimateErrorCovariance();
    std::memcpy(covariances + i * kStates * kStates, cov.data(), kStates * kStates * sizeof(double));
  }
}
