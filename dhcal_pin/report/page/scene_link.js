// Part of the scene within a report: moves the arm as the report asks.
addEventListener("message", ({ source, data }) => {
  if (source !== parent || !Array.isArray(data?.q)) return;
  dhcal.pause();
  dhcal.setJoints(data.q);
});
parent.postMessage({ dhcal: "ready" }, "*");
