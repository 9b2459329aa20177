// A click on a picture that is no link opens it in its own size.
document.addEventListener("click", (event) => {
  if (event.target.matches("article img") && !event.target.closest("a")) window.open(event.target.src);
});
