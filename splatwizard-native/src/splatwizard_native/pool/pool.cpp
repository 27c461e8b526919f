#include "face.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <mutex>
#include <system_error>
#include <thread>

namespace {

thread_local bool inside = false;  // of a loop: a loop in a loop runs in its thread

struct Loop {
  sw_body body;
  void* state;
  int64_t count, step;
  std::atomic<int64_t> next{0};
};

// Takes ranges of a loop until none is left.
void work(void* at) {
  Loop& loop = *static_cast<Loop*>(at);
  inside = true;
  for (int64_t begin; (begin = loop.next.fetch_add(loop.step)) < loop.count;)
    loop.body(loop.state, begin, std::min(begin + loop.step, loop.count));
  inside = false;
}

// Threads that sleep between loops. Never taken down: they end with the process.
class Team {
 public:
  const pid_t owner = getpid();

  // False if another caller's loop runs.
  bool run(int helpers, Loop& loop) {
    if (!free_.try_lock()) return false;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      while (size_ < helpers && add()) ++size_;
      loop_ = &loop;
      open_ = std::min(helpers, size_);
    }
    wake_.notify_all();
    work(&loop);
    {
      std::unique_lock<std::mutex> lock(mutex_);
      open_ = 0;  // who has not come so far finds nothing to do
      done_.wait(lock, [&] { return working_ == 0; });
    }
    free_.unlock();
    return true;
  }

 private:
  bool add() {
    try {
      std::thread([this] { live(); }).detach();
      return true;
    } catch (const std::system_error&) {  // no more threads are allowed here
      return false;
    }
  }

  void live() {
    for (std::unique_lock<std::mutex> lock(mutex_);;) {
      wake_.wait(lock, [&] { return open_ > 0; });
      --open_, ++working_;
      Loop* const loop = loop_;
      lock.unlock();
      work(loop);
      lock.lock();
      if (--working_ == 0) done_.notify_one();
    }
  }

  std::mutex free_, mutex_;
  std::condition_variable wake_, done_;
  Loop* loop_ = nullptr;
  int size_ = 0, open_ = 0, working_ = 0;
};

using Gomp = void (*)(void (*)(void*), void*, unsigned threads, unsigned flags);
std::atomic<Gomp> borrowed{nullptr};
std::atomic<pid_t> borrower{0};
std::atomic<Team*> team{nullptr};

// The team of this process: threads do not come along when a process is forked.
Team& own_team() {
  Team* found = team.load();
  while (found == nullptr || found->owner != getpid()) {
    Team* const made = new Team;  // what a forked process inherits is left as it is: its locks may be held for ever
    if (team.compare_exchange_strong(found, made)) return *made;
    delete made;
  }
  return *found;
}

}  // namespace

void splatwizard_pool_borrow(void* gomp_parallel) {
  borrower = getpid();
  borrowed = reinterpret_cast<Gomp>(gomp_parallel);
}

void splatwizard_pool_run(int32_t threads, int64_t count, int64_t grain, sw_body body, void* state) {
  if (count <= 0) return;
  const int64_t most = std::min<int64_t>(threads, (count + std::max<int64_t>(grain, 1) - 1) / std::max<int64_t>(grain, 1));
  if (inside || most < 2 || count <= grain) return body(state, 0, count);
  Loop loop{body, state, count, (count + most - 1) / most, {}};
  const Gomp gomp = borrowed.load();
  if (gomp != nullptr && borrower == getpid())
    gomp(work, &loop, unsigned(most), 0);
  else if (!own_team().run(int(most) - 1, loop))
    work(&loop);
}
