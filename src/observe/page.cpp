// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/page.h"

#include <fmt/format.h>

#include <charconv>
#include <nlohmann/json.hpp>

namespace vla::serve {
namespace {

using Json = nlohmann::ordered_json;

constexpr std::size_t kMaxBytes = 96 << 20;  // of the acts that are kept, as they went over the wire
constexpr std::size_t kMaxAnswer = 40;       // acts in an answer
constexpr std::size_t kMaxSeen = 8;          // pictures that are kept for a second viewer

constexpr const char* kForbidden = "open the address that vla serve has printed: it ends with a token\n";
constexpr const char* kNoFolder = "vla serve was started without a folder for recordings: --record DIR\n";

constexpr char kHtml[] =
#include "observe/page_html.inc"
    ;

std::string text_of(const Json& json) { return json.dump(-1, ' ', true, Json::error_handler_t::replace); }

std::string text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

/// The value of a name in `a=1&b=2`; empty where it is not there. Ours need no escapes.
std::string_view value_of(std::string_view query, std::string_view name) {
  while (!query.empty()) {
    const std::string_view part = query.substr(0, query.find('&'));
    if (part.size() > name.size() && part.starts_with(name) && part[name.size()] == '=')
      return part.substr(name.size() + 1);
    query.remove_prefix(std::min(query.size(), part.size() + 1));
  }
  return {};
}

std::uint64_t number_of(std::string_view query, std::string_view name) {
  const std::string_view text = value_of(query, name);
  std::uint64_t number = 0;
  std::from_chars(text.data(), text.data() + text.size(), number);
  return number;
}

const char* kind_of(const v1::View& view) {
  switch (view.image_case()) {
    case v1::View::kJpeg:
      return "jpeg";
    case v1::View::kPng:
      return "png";
    case v1::View::kRgb:
      return "rgb";
    default:
      return "absent";
  }
}

Error no_recipe() { return {Code::unsupported, "recipe", "the bundle", "none", "give vla replay its --bundle"}; }

Json record_json(const Recordings& recordings) {
  const Recordings::Standing standing = recordings.standing();
  return {{"on", standing.on},       {"folder", standing.folder},           {"requests", standing.n_request},
          {"bytes", standing.bytes}, {"max_bytes", recordings.max_bytes()}, {"why", standing.why}};
}

/// A PPM file, which the page draws itself: encoding would cost more than all else.
HttpReply pixmap(std::uint32_t width, std::uint32_t height, std::string_view rgb) {
  return {.type = "image/x-portable-pixmap", .body = fmt::format("P6 {} {} 255\n", width, height).append(rgb)};
}

Json dimensions_json(const google::protobuf::RepeatedPtrField<v1::Dimension>& dimensions) {
  Json json = Json::array();
  for (const v1::Dimension& dimension : dimensions)
    json.push_back({{"name", dimension.name()}, {"unit", dimension.unit()}});
  return json;
}

Json robot_json(const v1::Description& robot, const std::map<std::string, Page::Range>& ranges) {
  Json json = {{"embodiment", robot.embodiment()},
               {"horizon", robot.horizon()},
               {"rate_hz", robot.rate_hz()},
               {"actions", dimensions_json(robot.actions())},
               {"states", Json::array()}};
  for (const v1::StateSpec& state : robot.states()) {
    Json one = {{"name", state.name()}, {"dimensions", dimensions_json(state.dimensions())}};
    if (const auto found = ranges.find(robot.embodiment() + "/" + state.name()); found != ranges.end())
      one["low"] = found->second.low, one["high"] = found->second.high;
    json["states"].push_back(std::move(one));
  }
  return json;
}

Json chunk_json(const v1::ActionChunk& chunk) {
  Json stages = Json::array();
  for (const v1::Stage& stage : chunk.stages()) stages.push_back({stage.name(), stage.ms()});
  return {{"horizon", chunk.horizon()},
          {"d_action", chunk.d_action()},
          {"rate_hz", chunk.rate_hz()},
          {"actions", Json(std::vector<float>(chunk.actions().begin(), chunk.actions().end()))},
          {"notes", std::vector<std::string>(chunk.notes().begin(), chunk.notes().end())},
          {"queue_ms", chunk.queue_ms()},
          {"stages", std::move(stages)}};
}

Json act_json(const v1::Act& act) {
  Json json = {
      {"text", act.text()}, {"embodiment", act.embodiment()}, {"states", Json::object()}, {"views", Json::array()}};
  if (act.has_deadline_ms()) json["deadline_ms"] = act.deadline_ms();
  for (const v1::State& state : act.states())
    json["states"][state.name()] = std::vector<float>(state.values().begin(), state.values().end());
  for (const v1::View& view : act.views()) json["views"].push_back({{"name", view.name()}, {"kind", kind_of(view)}});
  return json;
}

}  // namespace

struct Page::Act {
  std::uint64_t id = 0;
  std::int64_t at_ms = 0;  // of its receipt, since 1970
  double total_ms = 0;     // from receipt to its answer
  std::string client, name, code;
  std::string in, out;  // until they are read
  std::size_t size = 0;

  v1::Request request;
  std::string json;  // empty until a viewer asks

  void read() {
    if (!json.empty()) return;
    v1::Response response;
    Json all = {{"id", id},         {"at_ms", at_ms}, {"total_ms", total_ms},
                {"client", client}, {"name", name},   {"code", code}};
    if (request.ParseFromString(in)) all.update(act_json(request.act()));
    if (response.ParseFromString(out) && response.has_chunk()) all["chunk"] = chunk_json(response.chunk());
    if (response.has_error())
      all["error"] = {{"where", response.error().where()},
                      {"expected", response.error().expected()},
                      {"found", response.error().found()}};
    json = text_of(all);
    in = {}, out = {};
  }
};

Result<std::unique_ptr<Page>> Page::open(const std::string& address, bool insecure, Sources sources) {
  std::unique_ptr<Page> page(new Page(std::move(sources)));
  const auto handle = [page = page.get()](const std::string& path, const std::string& query) {
    return page->reply(path, query);
  };
  const auto handle_post = [page = page.get()](const std::string& path, const std::string& query) {
    return page->reply_to_post(path, query);
  };
  VLA_TRY(page->http_, Http::open(address, "--page", insecure, handle, handle_post));
  return page;
}

std::string Page::url() const { return fmt::format("http://{}/?token={}", address(), sources_.token); }

void Page::describe(const v1::Description& description, const std::map<std::string, Range>& ranges, See see) {
  Json json = {{"bundle", description.bundle().name()},
               {"arch", description.bundle().arch()},
               {"device", description.runtime().device()},
               {"precision", description.runtime().precision()},
               {"kernels", description.runtime().kernels()},
               {"sees", see != nullptr},
               {"robots", Json::array()}};
  for (const v1::Description& robot : description.embodiments()) json["robots"].push_back(robot_json(robot, ranges));
  if (json["robots"].empty()) json["robots"].push_back(robot_json(description, ranges));
  const std::lock_guard lock(mutex_);
  policy_ = text_of(json);
  see_ = std::move(see);
}

void Page::answered(const Answered& answered) try {
  if (answered.request.kind != Kind::act || answered.out.empty()) return;
  const auto act = std::make_shared<Act>();
  const auto age = Clock::now() - answered.request.at;
  const auto at = std::chrono::system_clock::now() - age;
  act->at_ms = std::chrono::duration_cast<std::chrono::milliseconds>(at.time_since_epoch()).count();
  act->total_ms = std::chrono::duration<double, std::milli>(answered.sent - answered.request.at).count();
  act->client = answered.request.client, act->name = answered.request.name, act->code = answered.code();
  keep(act, answered.in, answered.out);
} catch (const std::exception&) {  // no memory: viewers miss this one
}

bool Page::show(const Recording::Record& record) {
  v1::Response response;
  response.ParseFromString(record.response);
  if (!response.has_chunk() && !response.has_error()) return false;
  const auto act = std::make_shared<Act>();
  act->at_ms = static_cast<std::int64_t>(record.at_ns / 1'000'000);
  act->total_ms = response.chunk().queue_ms() + response.chunk().engine_ms();
  act->client = fmt::format("{:08x}", record.client >> 32);
  act->code = response.has_error() ? code_name(wire::code_of(response.error().code())) : "ok";
  keep(act, std::as_bytes(std::span(record.request)), std::as_bytes(std::span(record.response)));
  return true;
}

void Page::keep(const std::shared_ptr<Act>& act, std::span<const std::byte> in, std::span<const std::byte> out) {
  act->size = in.size() + out.size();
  if (act->size > kMaxBytes) return;
  act->in = text_of(in), act->out = text_of(out);
  const std::lock_guard lock(mutex_);
  acts_.push_back(act);
  act->id = ++n_act_;
  bytes_ += act->size;
  for (; bytes_ > kMaxBytes; acts_.pop_front()) bytes_ -= acts_.front()->size;
}

bool Page::may_ask(const std::string& query) const {
  return sources_.is_same(value_of(query, "token"), sources_.token);
}

HttpReply Page::reply(const std::string& path, const std::string& query) {
  if (!may_ask(query)) return {.status = 403, .body = kForbidden};
  if (path == "/") return {.type = "text/html; charset=utf-8", .body = kHtml};
  if (path == "/acts") return acts_after(number_of(query, "after"));
  if (path == "/image")
    return image(number_of(query, "act"), number_of(query, "view"), value_of(query, "as") == "seen");
  if (path != "/policy") return {.status = 404, .body = "not here\n"};
  const std::lock_guard lock(mutex_);
  return {.type = "application/json", .body = policy_};
}

HttpReply Page::reply_to_post(const std::string& path, const std::string& query) {
  if (!may_ask(query)) return {.status = 403, .body = kForbidden};
  const std::string_view on = value_of(query, "on");
  if (path != "/record" || (on != "0" && on != "1")) return {.status = 404, .body = "not here\n"};
  if (sources_.recordings == nullptr) return {.status = 409, .body = kNoFolder};
  const Status done = on == "1" ? sources_.recordings->begin() : sources_.recordings->end();
  if (!done) return {.status = 409, .body = done.error().message() + "\n"};
  return {.type = "application/json", .body = text_of(record_json(*sources_.recordings))};
}

/// The newest acts after this one, oldest first.
HttpReply Page::acts_after(std::uint64_t id) {
  std::vector<std::shared_ptr<Act>> found;
  std::uint64_t first = 0, last = 0;
  {
    const std::lock_guard lock(mutex_);
    last = n_act_, first = n_act_ + 1 - acts_.size();
    for (auto act = acts_.rbegin(); act != acts_.rend() && (*act)->id > id && found.size() < kMaxAnswer; ++act)
      found.push_back(*act);
  }
  const Health health = sources_.health();
  Json record;  // null of a recording that is shown
  if (sources_.is_server) record = sources_.recordings ? record_json(*sources_.recordings) : Json{{"on", false}};
  const Json json = {{"ready", health.ready},
                     {"waiting", health.n_waiting},
                     {"computing", health.computing},
                     {"chunks", health.n_chunk},
                     {"errors", health.n_error},
                     {"uptime_s", health.uptime_s},
                     {"first", first},
                     {"last", last},
                     {"record", record}};
  std::string body = text_of(json);
  body.back() = ',';
  body += "\"acts\":[";
  for (auto act = found.rbegin(); act != found.rend(); ++act) {
    (*act)->read();
    body += (act == found.rbegin() ? "" : ",") + (*act)->json;
  }
  return {.type = "application/json", .body = body + "]}"};
}

const Result<Frame>& Page::seen(const Act& act, std::size_t view) {
  for (const Seen& kept : seen_)
    if (kept.act == act.id && kept.view == view) return kept.picture;
  See see;
  {
    const std::lock_guard lock(mutex_);
    see = see_;
  }
  seen_.push_back({act.id, view, see ? see(act.request.act(), static_cast<int>(view)) : no_recipe()});
  if (seen_.size() > kMaxSeen) seen_.pop_front();
  return seen_.back().picture;
}

HttpReply Page::image(std::uint64_t id, std::size_t view, bool as_seen) {
  std::shared_ptr<Act> act;
  {
    const std::lock_guard lock(mutex_);
    if (!acts_.empty() && id >= acts_.front()->id && id <= n_act_) act = acts_[id - acts_.front()->id];
  }
  if (act) act->read();
  if (!act || view >= static_cast<std::size_t>(act->request.act().views_size()))
    return {.status = 404, .body = "gone, or never there\n"};
  if (as_seen) {
    const Result<Frame>& picture = seen(*act, view);
    if (!picture) return {.status = 404, .body = picture.error().message() + "\n"};
    const auto& rgb = std::get<std::vector<std::uint8_t>>(picture->rgb);
    return pixmap(static_cast<std::uint32_t>(picture->width), static_cast<std::uint32_t>(picture->height),
                  text_of(std::as_bytes(std::span(rgb))));
  }
  const v1::View& found = act->request.act().views(static_cast<int>(view));
  if (found.has_jpeg()) return {.type = "image/jpeg", .body = found.jpeg()};
  if (found.has_png()) return {.type = "image/png", .body = found.png()};
  if (!found.has_rgb()) return {.status = 404, .body = "absent\n"};
  return pixmap(found.rgb().width(), found.rgb().height(), found.rgb().rows());
}

}  // namespace vla::serve
