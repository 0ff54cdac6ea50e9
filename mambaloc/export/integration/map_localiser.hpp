// Localize images in a bundle's map.safetensors. C++17; OpenCV 4.8 or a later 4: core, imgproc, features2d, calib3d.
//
//   mambaloc::MapLocalizer localizer(bytes);                   // of the file; throws std::exception
//   auto found = localizer.localize(rgb, intrinsics, &prior);  // prior: the network's pose, or nullptr
//   if (found.accepted || found.probability > 0.1) use(found); else use(network);  // 0.1: that the network is right
//
// Poses are world_from_cam: metres; OpenCV camera axes (x right, y down, z forward). One object serves any thread.
// Each step is that of mambaloc/runtime/maps in Python; INTEGRATION.md says how to check it with the bundle's frames.
#pragma once

#include <algorithm>
#include <bitset>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <numeric>
#include <set>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include <opencv2/calib3d.hpp>
#include <opencv2/core.hpp>
#include <opencv2/features2d.hpp>
#include <opencv2/imgproc.hpp>

#if CV_VERSION_MAJOR != 4 || CV_VERSION_MINOR < 8
#error "OpenCV 4.8 or a later 4: before, SIFT puts keypoints 0.25 px to the lower right"
#endif

namespace mambaloc {

struct CameraPose {
  cv::Matx33d rotation;  // world_from_cam
  cv::Vec3d position_m;
};

struct MapLocalization {
  CameraPose pose;
  int inliers = 0;
  bool accepted = false;
  double probability = 0;  // that it is within 0.2 m and 5 degrees; accepted from 0.95 on, where the position is sure, too
  double focal_scale = 1;  // times the given focal length, where matches contradict that; the probability is 0 then
  // Position in metres, then rotation in radians about the world's axes: the order and frame of ROS.
  cv::Matx66d covariance;
};

class MapLocalizer {
 public:
  explicit MapLocalizer(const std::vector<uint8_t>& bytes) { load(bytes); }

  // rgb: CV_8UC3, upright, of any size. intrinsics: in its pixels; the centre of the top-left pixel is (0, 0).
  MapLocalization localize(const cv::Mat& rgb, const cv::Matx33d& intrinsics, const CameraPose* prior = nullptr) const {
    const Features seen = detect(rgb, intrinsics);
    std::vector<cv::Vec3d> points;
    std::vector<cv::Vec2d> rays;
    match(seen, points, rays);
    const MapLocalization found = settled(seen, points, rays);
    if (!prior || found.accepted) return found;
    points.clear(), rays.clear();
    search(seen, carried(*prior, -1).first, 12.0 * near_, points, rays);
    const MapLocalization guided = settled(seen, points, rays);
    const auto rank = [](const MapLocalization& each) { return std::make_tuple(each.accepted, each.probability, each.inliers); };
    return rank(guided) > rank(found) ? guided : found;
  }

  // For a bridge to another language: height x width x 3 bytes, R G B; fx, fy, cx, cy in its pixels, or nullptr for the
  // map's own camera; the network's pose as x y z qw qx qy qz, or nullptr. Returns the same 7 numbers, the inliers, and
  // the covariance's 36; nothing where no pose is accepted, nor likelier to be right than the prior's, taken for 0.1; nor where the
  // map's own camera does not have the image's shape.
  std::vector<double> localize(const uint8_t* rgb, int height, int width, const double* camera, const double* prior) const {
    if (!camera && std::abs(width * size_.height - height * size_.width) > std::max(size_.width, size_.height)) return {};
    const cv::Matx33d k = camera ? cv::Matx33d(camera[0], 0, camera[2], 0, camera[1], camera[3], 0, 0, 1)
                                 : rescaled(intrinsics_, size_, {width, height});
    CameraPose around;
    if (prior) {
      const double w = prior[3], x = prior[4], y = prior[5], z = prior[6];
      around.position_m = {prior[0], prior[1], prior[2]};
      around.rotation = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    }
    const cv::Mat picture(height, width, CV_8UC3, const_cast<uint8_t*>(rgb));
    const MapLocalization found = localize(picture, k, prior ? &around : nullptr);
    if (!found.accepted && !(prior && found.probability > 0.1)) return {};
    cv::Vec3d turn;
    cv::Rodrigues(found.pose.rotation, turn);
    const double angle = cv::norm(turn), share = angle > 1e-12 ? std::sin(angle / 2) / angle : 0.5;
    const cv::Vec3d p = found.pose.position_m, xyz = turn * share;
    std::vector<double> flat{p[0], p[1], p[2], std::cos(angle / 2), xyz[0], xyz[1], xyz[2], double(found.inliers)};
    flat.insert(flat.end(), found.covariance.val, found.covariance.val + 36);
    return flat;
  }

 private:
  struct Features {
    std::vector<cv::Vec2d> rays;    // where keypoints lie in the plane at depth 1
    std::vector<cv::Vec2d> shares;  // and in the image, whose corners are (0, 0) and (1, 1)
    cv::Mat descriptors;            // (N, 128) float, unit length
    cv::Vec2d upper_left, lower_right;
  };

  static cv::Matx33d rescaled(const cv::Matx33d& k, cv::Size from, cv::Size to) {
    const double x = double(to.width) / from.width, y = double(to.height) / from.height;
    return cv::Matx33d(x, 0, (x - 1) / 2, 0, y, (y - 1) / 2, 0, 0, 1) * k;  // corners stay corners
  }

  static cv::Vec2d normalised(const cv::Matx33d& k, double x, double y) {
    const double v = (y - k(1, 2)) / k(1, 1);
    return {(x - k(0, 2) - k(0, 1) * v) / k(0, 0), v};
  }

  static cv::Vec2d project(const CameraPose& pose, const cv::Vec3d& point) {
    const cv::Vec3d cam = pose.rotation.t() * (point - pose.position_m);
    const double nan = std::numeric_limits<double>::quiet_NaN();
    return cam[2] > 1e-9 ? cv::Vec2d(cam[0] / cam[2], cam[1] / cam[2]) : cv::Vec2d(nan, nan);
  }

  static cv::Matx33d turned(const cv::Vec3d& radians) {
    cv::Matx33d rotation;
    cv::Rodrigues(radians, rotation);
    return rotation;
  }

  Features detect(const cv::Mat& rgb, const cv::Matx33d& k) const {
    const double scale = std::min(1.0, intrinsics_(0, 0) / k(0, 0));  // things as large as in the map's images
    const cv::Size size(std::max(1, cvRound(rgb.cols * scale)), std::max(1, cvRound(rgb.rows * scale)));
    cv::Mat grey, found;
    cv::cvtColor(rgb, grey, cv::COLOR_RGB2GRAY);
    if (size != grey.size()) cv::resize(grey, grey, size, 0, 0, cv::INTER_AREA);
    std::vector<cv::KeyPoint> keypoints;
    // The last argument is the precise upscale.
    cv::SIFT::create(1000, 3, 0.02, 10, 1.6, true)->detectAndCompute(grey, cv::noArray(), keypoints, found);
    const cv::Matx33d small = rescaled(k, rgb.size(), size);
    Features seen;
    for (int i = 0; i < found.rows; ++i) {
      cv::Mat row = found.row(i);
      cv::sqrt(row / std::max(cv::sum(row)[0], 1.0), row);  // RootSIFT
    }
    seen.descriptors = found;
    const bool is_own = cv::norm(rescaled(small, size, size_) - intrinsics_, cv::NORM_INF) <= 0.01 * size_.width &&
                        std::abs(double(size.height) * size_.width / size.width - size_.height) <= 0.01 * size_.width;
    for (const auto& each : keypoints) {
      const cv::Vec2d ray = normalised(small, each.pt.x, each.pt.y);
      seen.rays.push_back(is_own ? undistorted(ray) : ray);
      seen.shares.emplace_back((each.pt.x + 0.5) / size.width, (each.pt.y + 0.5) / size.height);
    }
    seen.upper_left = normalised(small, -0.5, -0.5);
    seen.lower_right = normalised(small, size.width - 0.5, size.height - 0.5);
    return seen;
  }

  // claimed = focal * ideal * (1 + radial * |ideal|^2)
  cv::Vec2d undistorted(const cv::Vec2d& claimed) const {
    const cv::Vec2d straight = claimed * (1 / focal_);
    cv::Vec2d ideal = straight;
    for (int i = 0; i < 10; ++i) ideal = straight * (1 / (1 + radial_ * ideal.dot(ideal)));
    return ideal;
  }

  static float distance(float similarity) { return std::sqrt(std::max(2 - 2 * similarity, 0.0f)); }

  // Each row's best column, or -1 where the second best is about as near (Lowe's ratio test).
  static std::vector<int> unambiguous(const cv::Mat& similarity, float ratio) {
    std::vector<int> best(similarity.rows, -1);
    for (int i = 0; i < similarity.rows && similarity.cols > 1; ++i) {
      const float* row = similarity.ptr<float>(i);
      const int first = int(std::max_element(row, row + similarity.cols) - row);
      float second = -1;
      for (int j = 0; j < similarity.cols; ++j) if (j != first) second = std::max(second, row[j]);
      if (distance(row[first]) < ratio * distance(second)) best[i] = first;
    }
    return best;
  }

  // Of the position, in the direction that is least sure.
  static double deviation(const cv::Matx66d& covariance) {
    cv::Vec3d variances;
    cv::eigen(covariance.get_minor<3, 3>(0, 0), variances);  // the largest first
    return std::sqrt(variances[0]);
  }

  // Match the points that most frames see, all at once.
  void match(const Features& seen, std::vector<cv::Vec3d>& points, std::vector<cv::Vec2d>& rays) const {
    if (seen.rays.empty()) return;
    const std::vector<int> best = unambiguous(seen.descriptors * often_descriptors_.t(), 0.85f);
    for (size_t i = 0; i < best.size(); ++i)
      if (best[i] >= 0) points.push_back(points_[often_[best[i]]]), rays.push_back(seen.rays[i]);
  }

  struct Sight {
    int keypoint;
    bool is_distinctive;  // the point is the most similar of all points in view
  };

  // RANSAC; then search around the pose and refine it, twice.
  MapLocalization settled(const Features& seen, const std::vector<cv::Vec3d>& matched, const std::vector<cv::Vec2d>& at) const {
    MapLocalization answer;
    CameraPose start;
    if (!ransac(matched, at, start)) return answer;
    CameraPose pose = start;
    double finest = 0;
    std::vector<cv::Vec3d> points;
    std::vector<cv::Vec2d> rays;
    std::vector<Sight> sights;
    double scale = near_ / 2;
    std::vector<double> off;
    for (double window : {6.0, 2.0}) {
      points.clear(), rays.clear(), sights.clear();
      search(seen, pose, window * near_, points, rays, &sights);
      if (points.size() < 4) return MapLocalization();
      finest = scale;
      answer.covariance = refine(pose, points, rays, finest);
      off.clear();
      for (size_t i = 0; i < points.size(); ++i) off.push_back(cv::norm(project(pose, points[i]) - rays[i]));
      std::vector<double> sorted = off;
      std::sort(sorted.begin(), sorted.end());
      const double median = (sorted[(sorted.size() - 1) / 2] + sorted[sorted.size() / 2]) / 2;
      scale = std::min(near_ / 2, std::max(2.5 * median, 0.1 * near_));
    }
    answer.inliers = int(std::count_if(off.begin(), off.end(), [&](double each) { return each <= near_; }));
    const auto [focal, focal_deviation] = focal_scale(pose, points, rays, finest);
    const bool is_another = std::abs(std::log(focal)) > std::max(0.03, 3.0 * focal_deviation);
    if (is_another) answer.focal_scale = focal;
    double unsure_by = deviation(answer.covariance) / unit_m_;  // by all matches, or by distinctive ones where that is more
    if (!is_another) {
      std::vector<cv::Vec3d> theirs;
      std::vector<cv::Vec2d> where;
      std::set<std::pair<int, int>> cells;  // of a grid of 4 x 4
      for (size_t i = 0; i < points.size(); ++i) {
        if (!sights[i].is_distinctive) continue;
        theirs.push_back(points[i]), where.push_back(rays[i]);
        const cv::Vec2d share = seen.shares[sights[i].keypoint];
        if (off[i] <= near_) cells.insert({int(std::floor(4 * share[0])), int(std::floor(4 * share[1]))});
      }
      if (theirs.size() >= 4) {
        CameraPose again = pose;
        const double alone = deviation(refine(again, theirs, where, finest)) / unit_m_;
        unsure_by = std::isfinite(alone) ? std::max(unsure_by, alone) : alone;
        cv::Vec3d turn;
        cv::Rodrigues(start.rotation.t() * pose.rotation, turn);
        const double evidence = -4.9 + 3.48 * std::log(double(cells.size()) + 0.5) - 0.34 * std::log(std::max(unsure_by, 1e-3)) -
                                1.01 * std::log(cv::norm(turn) * 180 / CV_PI + 0.1);
        answer.probability = std::isfinite(unsure_by) ? 1 / (1 + std::exp(-evidence)) : 0;
      }
    }
    answer.accepted = answer.probability >= 0.95 && unsure_by <= 0.12 && answer.inliers >= least_inliers_;
    const auto [given, unsure] = carried(pose, 1);
    answer.pose = given;
    answer.covariance = 1.25 * answer.covariance + unsure;  // neighbouring matches share errors
    return answer;
  }

  bool ransac(const std::vector<cv::Vec3d>& points, const std::vector<cv::Vec2d>& rays, CameraPose& pose) const {
    if (points.size() < 4) return false;
    cv::Vec3d turn, shift;
    std::vector<int> inliers;
    try {
      if (!cv::solvePnPRansac(points, rays, cv::Matx33d::eye(), cv::noArray(), turn, shift, false, 1000, float(near_), 0.9999,
                              inliers, cv::SOLVEPNP_SQPNP))
        return false;
    } catch (const cv::Exception&) {  // matches that are all one point, or on a line
      return false;
    }
    if (inliers.empty() || !std::isfinite(cv::norm(turn) + cv::norm(shift))) return false;
    pose.rotation = turned(turn).t();
    pose.position_m = -(pose.rotation * shift);
    return true;
  }

  // Match again what the pose projects near a keypoint, of the points that one of the 8 nearest key frames sees.
  void search(const Features& seen, const CameraPose& pose, double radius, std::vector<cv::Vec3d>& points,
              std::vector<cv::Vec2d>& rays, std::vector<Sight>* sights = nullptr) const {
    const Place here = place(pose, unit_m_);
    std::vector<int> order(places_.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return apart(here, places_[a]) < apart(here, places_[b]); });
    order.resize(std::min<size_t>(order.size(), 8));
    std::vector<int> visible;
    std::vector<cv::Vec2d> projected;
    cv::Mat theirs;
    for (size_t p = 0; p < points_.size(); ++p) {
      if (std::none_of(order.begin(), order.end(), [&](int k) { return views_[p * view_bytes_ + k / 8] >> (7 - k % 8) & 1; })) continue;
      const cv::Vec2d ray = project(pose, points_[p]);
      if (!(ray[0] >= seen.upper_left[0] && ray[1] >= seen.upper_left[1] && ray[0] <= seen.lower_right[0] &&
            ray[1] <= seen.lower_right[1]))
        continue;
      visible.push_back(int(p));
      projected.push_back(ray);
      theirs.push_back(descriptors_.row(int(p)));
    }
    if (visible.empty() || seen.rays.empty()) return;
    cv::Mat similarity = seen.descriptors * theirs.t();
    std::vector<float> most;
    for (int i = 0; i < similarity.rows; ++i) {
      const float* row = similarity.ptr<float>(i);
      most.push_back(*std::max_element(row, row + similarity.cols));
    }
    for (int i = 0; i < similarity.rows; ++i)
      for (int j = 0; j < similarity.cols; ++j)
        if (cv::norm(seen.rays[i] - projected[j]) > radius) similarity.at<float>(i, j) = -1;
    const std::vector<int> best = unambiguous(similarity, 0.95f);
    for (int i = 0; i < similarity.rows; ++i) {
      const int j = best[i];
      if (j < 0 || distance(similarity.at<float>(i, j)) >= 0.9f) continue;
      bool is_mutual = true;
      for (int other = 0; other < similarity.rows; ++other)
        is_mutual &= similarity.at<float>(other, j) <= similarity.at<float>(i, j);
      if (!is_mutual) continue;
      points.push_back(points_[visible[j]]), rays.push_back(seen.rays[i]);
      if (sights) sights->push_back({i, similarity.at<float>(i, j) >= most[i]});
    }
  }

  struct Linear {
    cv::Vec2d off, seen;          // the residual in halves of near; where the point is seen
    cv::Vec<double, 6> row[2];    // slopes of the residual
    double square() const { return off.dot(off); }
    double weight() const { return 1 / (1 + square()); }  // Cauchy's
  };

  // Empty where a point lies behind the camera.
  static std::vector<Linear> linearised(const CameraPose& pose, const std::vector<cv::Vec3d>& points,
                                        const std::vector<cv::Vec2d>& rays, double near) {
    std::vector<Linear> all;
    for (size_t i = 0; i < points.size(); ++i) {
      const cv::Vec3d towards = points[i] - pose.position_m, cam = pose.rotation.t() * towards;
      if (cam[2] <= 1e-9) return {};
      Linear one;
      one.seen = {cam[0] / cam[2], cam[1] / cam[2]};
      one.off = (one.seen - rays[i]) * (2 / near);
      for (int axis = 0; axis < 2; ++axis) {
        cv::Vec3d slope;
        for (int c = 0; c < 3; ++c) slope[c] = (pose.rotation(c, axis) - one.seen[axis] * pose.rotation(c, 2)) * 2 / near / cam[2];
        const cv::Vec3d by_turn = slope.cross(towards);
        one.row[axis] = {-slope[0], -slope[1], -slope[2], by_turn[0], by_turn[1], by_turn[2]};
      }
      all.push_back(one);
    }
    return all;
  }

  struct Equations {
    double cost = std::numeric_limits<double>::infinity();
    cv::Matx66d normal = cv::Matx66d::eye();
    cv::Vec<double, 6> right = {};
  };

  static Equations equations(const std::vector<Linear>& all) {
    Equations sum;
    if (all.empty()) return sum;
    sum.cost = 0, sum.normal = cv::Matx66d::zeros();
    for (const Linear& one : all) {
      sum.cost += std::log1p(one.square());
      for (int axis = 0; axis < 2; ++axis) {
        sum.normal += one.weight() * (one.row[axis] * one.row[axis].t());
        sum.right -= one.weight() * one.off[axis] * one.row[axis];
      }
    }
    return sum;
  }

  // Huber's sandwich: the cost's Hessian, and each match's gradient.
  static cv::Matx66d sandwich(const std::vector<Linear>& all) {
    cv::Matx66d hessian = cv::Matx66d::zeros(), squares = cv::Matx66d::zeros();
    for (const Linear& one : all) {
      const cv::Vec<double, 6> gradient = one.weight() * (one.off[0] * one.row[0] + one.off[1] * one.row[1]);
      for (const auto& row : one.row) hessian += one.weight() * (row * row.t());
      hessian -= 2 * (gradient * gradient.t());
      squares += gradient * gradient.t();
    }
    const double freedom = 2 * double(all.size()) / std::max(2 * double(all.size()) - 6, 1.0);
    const cv::Matx66d inverse = hessian.inv(cv::DECOMP_SVD);
    return freedom * (inverse * squares * inverse);
  }

  // How much longer than given the focal length is, and its deviation: a step of pose and focal length together.
  static std::pair<double, double> focal_scale(const CameraPose& pose, const std::vector<cv::Vec3d>& points,
                                               const std::vector<cv::Vec2d>& rays, double near) {
    using Row = cv::Vec<double, 7>;
    cv::Matx<double, 7, 7> normal = cv::Matx<double, 7, 7>::zeros();
    Row right = Row::all(0);
    double squares = 0;
    const std::vector<Linear> all = linearised(pose, points, rays, near);
    for (const Linear& one : all) {
      squares += one.weight() * one.square();
      for (int axis = 0; axis < 2; ++axis) {
        Row row;
        for (int c = 0; c < 6; ++c) row[c] = one.row[axis][c];
        row[6] = one.seen[axis] * 2 / near;
        normal += one.weight() * (row * row.t());
        right -= one.weight() * one.off[axis] * row;
      }
    }
    const cv::Matx<double, 7, 7> inverse = normal.inv(cv::DECOMP_SVD);
    const double variance = inverse(6, 6) * squares / std::max(2 * double(all.size()) - 7, 1.0);
    if (!(variance > 0)) return {1, std::numeric_limits<double>::infinity()};
    return {std::exp((inverse * right)[6]), std::sqrt(variance)};
  }

  // Levenberg-Marquardt with Cauchy's weights; returns the covariance.
  static cv::Matx66d refine(CameraPose& pose, const std::vector<cv::Vec3d>& points, const std::vector<cv::Vec2d>& rays, double near) {
    double damping = 1e-4;
    Equations now = equations(linearised(pose, points, rays, near));
    for (int i = 0; i < 10; ++i) {
      cv::Matx66d damped = now.normal + 1e-12 * cv::Matx66d::eye();
      for (int d = 0; d < 6; ++d) damped(d, d) += damping * now.normal(d, d);
      const cv::Vec<double, 6> step = damped.solve(now.right, cv::DECOMP_LU);
      const CameraPose moved{turned({step[3], step[4], step[5]}) * pose.rotation, pose.position_m + cv::Vec3d(step[0], step[1], step[2])};
      const Equations next = equations(linearised(moved, points, rays, near));
      if (next.cost <= now.cost) {
        const bool has_converged = now.cost - next.cost <= 1e-6 * now.cost;
        pose = moved, damping /= 10, now = next;
        if (has_converged) break;
      } else {
        damping *= 10;
      }
    }
    return sandwich(linearised(pose, points, rays, near));
  }

  using Place = cv::Vec<double, 6>;  // a move by the key frames' spread counts as much as a turn by 25 degrees

  static Place place(const CameraPose& pose, double unit_m) {
    const double radians = 25 * CV_PI / 180;
    const cv::Vec3d p = pose.position_m * (1 / std::max(unit_m, 1e-12));
    return {p[0], p[1], p[2], pose.rotation(0, 2) / radians, pose.rotation(1, 2) / radians, pose.rotation(2, 2) / radians};
  }

  static double apart(const Place& a, const Place& b) { return cv::norm(a - b); }

  static double kernel(const Place& a, const Place& b) {  // Matern's, of smoothness 3/2
    const double far = std::sqrt(3.0) * apart(a, b) / 8;
    return (1 + far) * std::exp(-far);
  }

  // From the map's adjusted frame to that of the given poses (way 1), with the covariance of what is added; or back (-1).
  std::pair<CameraPose, cv::Matx66d> carried(const CameraPose& pose, int way) const {
    if (drift_.empty()) return {pose, cv::Matx66d::zeros()};
    const Place here = place(pose, drift_unit_m_);
    cv::Mat near(1, drift_.rows, CV_64F);
    for (int k = 0; k < near.cols; ++k) near.at<double>(k) = kernel(here, drift_places_[k]);
    const cv::Mat move = near * drift_;
    const double* m = move.ptr<double>();
    const cv::Matx33d rotation = pose.rotation * turned(cv::Vec3d(m[3], m[4], m[5]) * way);
    const cv::Vec3d shift = (way > 0 ? pose.rotation : rotation) * cv::Vec3d(m[0], m[1], m[2]);
    const double unsure = std::max(1 + nugget_ - cv::Mat(near * inverse_ * near.t()).at<double>(0), 0.0);
    cv::Matx66d axes = cv::Matx66d::zeros();
    for (int r = 0; r < 3; ++r) for (int c = 0; c < 3; ++c) axes(r, c) = axes(r + 3, c + 3) = pose.rotation(r, c);
    return {{rotation, pose.position_m + shift * way}, unsure * (axes * amplitude_ * axes.t())};
  }

  // A safetensors file: 8 bytes, the header's length; the header, JSON; raw arrays, little-endian.
  void load(const std::vector<uint8_t>& bytes) {
    uint64_t length = 0;
    if (bytes.size() < 8) throw std::runtime_error("map: is not a safetensors file");
    std::memcpy(&length, bytes.data(), 8);
    if (length > bytes.size() - 8) throw std::runtime_error("map: is cut short");
    const std::string header(bytes.begin() + 8, bytes.begin() + 8 + std::ptrdiff_t(length));
    const int from_text = cv::FileStorage::READ | cv::FileStorage::MEMORY | cv::FileStorage::FORMAT_JSON;
    const cv::FileStorage json(header, from_text);
    const std::string text = json["__metadata__"]["about"];
    const cv::FileStorage about(text, from_text);
    if (int(about["version"]) != 1) throw std::runtime_error("map: is of another version");
    const std::string kind = about["keypoints"];
    if (!kind.empty() && kind != "sift") throw std::runtime_error("map: has " + kind + " keypoints, this reads sift");
    least_inliers_ = int(about["least_inliers"]);
    nugget_ = about["nugget"].empty() ? 1e-3 : double(about["nugget"]);
    const auto array = [&](const char* name, int type, int columns) {
      const cv::FileNode entry = json[name];
      if (entry.empty()) throw std::runtime_error(std::string("map: missing ") + name);
      const double begin = entry["data_offsets"][0], end = entry["data_offsets"][1];
      const double row = columns * double(CV_ELEM_SIZE(type));
      if (!(0 <= begin && begin <= end && end <= double(bytes.size() - 8 - length)) || std::fmod(end - begin, row) != 0)
        throw std::runtime_error(std::string("map: has a strange ") + name);
      cv::Mat whole(int((end - begin) / row), columns, type);
      if (!whole.empty()) std::memcpy(whole.data, bytes.data() + 8 + length + size_t(begin), size_t(end - begin));
      return whole;
    };
    const cv::Mat points = array("points_m", CV_32F, 3), stored = array("descriptors", CV_8U, 128);
    const cv::Mat poses = array("key_poses", CV_64F, 16), lens = array("lens", CV_64F, 2), size = array("size", CV_32S, 4);
    drift_ = array("drift", CV_64F, 6);
    view_bytes_ = size_t(poses.rows + 7) / 8;
    const cv::Mat views = array("views", CV_8U, int(view_bytes_));
    if (points.empty() || stored.rows != points.rows || views.rows != points.rows || lens.rows != 1 || size.rows != 1 ||
        drift_.rows > poses.rows)
      throw std::runtime_error("map: its arrays do not belong together");
    intrinsics_ = cv::Matx33d(array("intrinsics", CV_64F, 9).ptr<double>());
    size_ = {size.at<int>(0), size.at<int>(2)};  // int64, little-endian
    focal_ = lens.at<double>(0), radial_ = lens.at<double>(1);
    near_ = 4.5 * size_.width / 160 / intrinsics_(0, 0);
    views_.assign(views.data, views.data + views.total());
    stored.convertTo(descriptors_, CV_32F);
    for (int p = 0; p < points.rows; ++p) {
      points_.emplace_back(points.at<float>(p, 0), points.at<float>(p, 1), points.at<float>(p, 2));
      cv::Mat row = descriptors_.row(p);
      row *= 1 / std::max(cv::norm(row), 1.0);
    }
    std::vector<int> counts(points_.size());
    for (size_t i = 0; i < views_.size(); ++i) counts[i / view_bytes_] += int(std::bitset<8>(views_[i]).count());
    often_.resize(points_.size());
    std::iota(often_.begin(), often_.end(), 0);
    std::stable_sort(often_.begin(), often_.end(), [&](int a, int b) { return counts[a] > counts[b]; });
    often_.resize(std::min<size_t>(often_.size(), 2500));
    for (int p : often_) often_descriptors_.push_back(descriptors_.row(p));
    std::vector<CameraPose> cameras;
    for (int k = 0; k < poses.rows; ++k) {
      const cv::Matx44d matrix(poses.ptr<double>(k));
      cameras.push_back({matrix.get_minor<3, 3>(0, 0), {matrix(0, 3), matrix(1, 3), matrix(2, 3)}});
    }
    unit_m_ = spread_m(cameras);
    for (const auto& each : cameras) places_.push_back(place(each, unit_m_));
    if (drift_.empty()) return;
    cameras.resize(drift_.rows);  // those that were added to the map later have none
    drift_unit_m_ = spread_m(cameras);
    for (const auto& each : cameras) drift_places_.push_back(place(each, drift_unit_m_));
    cv::Mat covariance(drift_.rows, drift_.rows, CV_64F);
    for (int a = 0; a < drift_.rows; ++a)
      for (int b = 0; b < drift_.rows; ++b)
        covariance.at<double>(a, b) = kernel(drift_places_[a], drift_places_[b]) + (a == b ? nugget_ : 0);
    inverse_ = covariance.inv(cv::DECOMP_CHOLESKY);
    amplitude_ = cv::Matx66d(cv::Mat(drift_.t() * covariance * drift_ / drift_.rows).ptr<double>());
  }

  static double spread_m(const std::vector<CameraPose>& cameras) {
    cv::Vec3d mean(0, 0, 0);
    for (const auto& each : cameras) mean += each.position_m * (1.0 / cameras.size());
    double squares = 0;
    for (const auto& each : cameras) squares += cv::norm(each.position_m - mean, cv::NORM_L2SQR) / cameras.size();
    return std::sqrt(squares);
  }

  std::vector<cv::Vec3d> points_;
  std::vector<int> often_;  // the points that most key frames see
  cv::Mat descriptors_, often_descriptors_, drift_, inverse_;
  std::vector<uint8_t> views_;
  size_t view_bytes_ = 0;
  std::vector<Place> places_, drift_places_;
  cv::Matx33d intrinsics_;
  cv::Matx66d amplitude_;
  cv::Size size_;
  double focal_ = 1, radial_ = 0, near_ = 0, unit_m_ = 0, drift_unit_m_ = 0, nugget_ = 0;
  int least_inliers_ = 0;
};

}  // namespace mambaloc
